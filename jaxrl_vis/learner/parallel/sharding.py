"""Several devices: a mesh with an axis for seeds and one for the data of each learner.

    seed    learners are placed on different devices and never communicate
    data    devices share one learner: each steps its part of the environments, keeps these episodes in its part of the replay,
            and samples its part of every batch from there; gradients, statistics and metrics are averaged

Every device runs the whole training iteration on its own part (`jax.shard_map`), so only averages over shards are
communicated. Random numbers are generated for the whole learner, and each device uses its part of them: environment number 7
starts and explores identically on any number of devices. Batches differ in one respect from those of a single device: part d of
a batch is sampled from the episodes of the environments of device d, so each group of environments contributes equally.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec

from jaxrl_vis.config import Config, data_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.parallel.shards import DATA, ONE, Shards
from jaxrl_vis.types import LoopState, ReplayState

SEED = "seed"
"""Name of the mesh axis along which seeds are placed."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Placement of a run's seeds, and of each learner's shards, on devices; create it with `make_layout`.

    Between iterations, the arrays of a sharded learner's replay are [S, rollouts, E, ...] instead of [S, rollouts * E, ...]:
    the same bytes, so that a run may continue on another number of devices.

    Attributes:
        mesh: Mesh of devices with the axes `SEED` and `DATA`; None for JAX's first device and plain arrays.
        shards: Shards of each learner.
    """

    mesh: Mesh | None = None
    shards: Shards = ONE

    @property
    def num_devices(self) -> int:
        """Number of devices used."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def name(self) -> str:
        """Human-readable name, such as ``2 x NVIDIA H200``."""
        kind = jax.devices()[0].device_kind
        if self.mesh is None:
            return kind
        shared = f", each learner on {self.shards.count} of them" if self.shards.count > 1 else ""
        return f"{self.num_devices} x {kind}{shared}"

    @property
    def devices(self) -> list[Any]:
        """Devices of this process that the run uses."""
        return jax.devices()[:1] if self.mesh is None else list(self.mesh.local_devices)

    @property
    def by_seed(self) -> Spec:
        """Spec of arrays [S, ...]: each seed on its devices."""
        return Spec(SEED)

    @property
    def by_environment(self) -> Spec:
        """Spec of arrays [S, E, ...]: each environment on its device."""
        return Spec(SEED, DATA)

    @property
    def host_spec(self) -> Spec:
        """Spec of arrays [S, ...] for the host: replicated if other processes have some of the seeds."""
        return Spec() if jax.process_count() > 1 else Spec(SEED)

    @property
    def replicated(self) -> Spec:
        """Spec of replicated arrays."""
        return Spec()

    @property
    def replay(self) -> Any:
        """Specs of a `ReplayState`."""
        episodes = Spec(SEED) if self.shards.count == 1 else Spec(SEED, None, DATA)
        return ReplayState(episodes=episodes, size=Spec(SEED))  # type: ignore[arg-type]

    @property
    def loop(self) -> Any:
        """Specs of a `LoopState`."""
        return LoopState(train=Spec(SEED), replay=self.replay, key=Spec(SEED), iteration=Spec())  # type: ignore[arg-type]

    def shardings(self, specs: Any) -> Any:
        """Convert a tree of partition specs to shardings for `jax.jit` and `jax.device_put`; None on one device."""
        if self.mesh is None:
            return None
        make_sharding = functools.partial(NamedSharding, self.mesh)
        return jax.tree.map(make_sharding, specs, is_leaf=lambda leaf: isinstance(leaf, Spec))

    def spread(
        self, function: Callable, in_specs: tuple, out_specs: Any, jit: Callable, final_specs: Any = None, **options: Any
    ) -> Any:
        """Wrap a function of one device's part in `jax.shard_map` and ``jit``; on one device, in ``jit`` alone, without specs.

        Args:
            function: Function of one device's parts of its arguments.
            in_specs: A partition spec, or a tree of them, for each argument.
            out_specs: Partition specs by which the devices' results are assembled, a spec or a tree of them.
            jit: Compiling transformation, such as `jax.jit`.
            final_specs: Partition specs to which the assembled results are then resharded, such as `replicated` for the host;
                None for ``out_specs``.
            **options: Further arguments of ``jit``.

        Returns:
            The jitted function, of whole arrays.
        """
        if self.mesh is None:
            return jit(function, **options)
        # Kernels and custom rules do not declare along which axes their results vary, so JAX cannot check it.
        mapped = jax.shard_map(function, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
        shardings = {"in_shardings": self.shardings(in_specs), "out_shardings": self.shardings(final_specs or out_specs)}
        return jit(mapped, **shardings, **options)

    def with_shardings(self, shapes: Any, specs: Any) -> Any:
        """Return shapes (as from `jax.eval_shape`) with shardings; unchanged on one device.

        Args:
            shapes: A pytree.
            specs: Tree of partition specs, a prefix of the tree ``shapes``.
        """
        if self.mesh is None:
            return shapes

        def placed(sharding: NamedSharding, subtree: Any) -> Any:
            return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), subtree)

        return jax.tree.map(placed, self.shardings(specs), shapes)

    def put(self, tree: Any, specs: Any) -> Any:
        """Return a tree of arrays placed by ``specs``, a prefix of the tree; unchanged on one device."""
        if self.mesh is None:
            return tree

        def placed(sharding: NamedSharding, subtree: Any) -> Any:
            return jax.tree.map(lambda leaf: put_array(leaf, sharding), subtree)

        return jax.tree.map(placed, self.shardings(specs), tree)

    def fold_replay(self, replay: ReplayState, num_envs: int) -> ReplayState:
        """Return one device's part of a learner's replay in the form in which it is stored between two iterations.

        Args:
            replay: Replay of one learner, [rollouts * E, ...].
            num_envs: E, number of environments in this part.

        Returns:
            The replay with episodes [rollouts, E, ...] and the size of the whole learner's replay; unchanged if a learner has a
            single device.
        """
        count = self.shards.count
        if count == 1:
            return replay
        episodes = jax.tree.map(lambda leaf: leaf.reshape(-1, num_envs, *leaf.shape[1:]), replay.episodes)
        return ReplayState(episodes=episodes, size=replay.size * count)

    def unfold_replay(self, replay: ReplayState) -> ReplayState:
        """Invert `fold_replay`."""
        count = self.shards.count
        if count == 1:
            return replay
        episodes = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), replay.episodes)
        return ReplayState(episodes=episodes, size=replay.size // count)


def put_array(array: Any, sharding: Any) -> jax.Array:
    """Place an array, possibly on devices of several processes, all of which must call this with the same array."""
    if sharding.is_fully_addressable or getattr(array, "sharding", None) == sharding:
        return jax.device_put(array, sharding)
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        words = put_array(np.asarray(jax.random.key_data(array)), sharding)
        return jax.jit(jax.random.wrap_key_data, out_shardings=sharding)(words)
    host = np.asarray(array)
    return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])


ONE_DEVICE = Layout()
"""Layout with everything on JAX's first device."""


def _avoid_shardy() -> None:
    """Let XLA partition programs by GSPMD if Shardy would crash.

    In jaxlib 0.11 a pass of Shardy reads past the end of a list and crashes with a segmentation fault if constants that a
    `jax.shard_map` closes over are unused (`ManualComputationUnusedInputsPattern`), as is common with physics models.
    """
    if jax.__version_info__ >= (0, 11):
        jax.config.update("jax_use_shardy_partitioner", False)


def make_layout(config: Config) -> Layout:
    """Place the seeds of a run, and the shards of each learner, on devices.

    For several devices, this may change JAX's global configuration (`_avoid_shardy`).

    Args:
        config: Configuration of the run, of which ``devices``, ``data_devices`` and ``seeds`` are used.

    Raises:
        RequestError: There are too few devices, or a run of several processes would leave some of them unused.
    """
    if config.run.devices == 1 and jax.process_count() == 1:
        return ONE_DEVICE
    available = jax.devices()
    if config.run.devices > len(available):
        what = "there is 1" if len(available) == 1 else f"there are {len(available)}"
        raise RequestError(
            f"devices {config.run.devices} asks for more than {what} ({available[0].device_kind}): write --devices all"
        )
    if jax.process_count() > 1 and config.run.devices < len(available):
        raise RequestError(
            f"devices {config.run.devices} would leave some of the {len(available)} devices of {jax.process_count()} processes "
            "without work: write --devices all, or start fewer processes"
        )
    _avoid_shardy()
    along_data = data_devices(config)
    devices = np.asarray(available[: config.run.devices], dtype=object).reshape(-1, along_data)
    return Layout(Mesh(devices, (SEED, DATA)), Shards(along_data))
