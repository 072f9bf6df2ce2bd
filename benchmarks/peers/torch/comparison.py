"""Comparison of our gradient steps with PyTorch's (`learner`), on the same device and in the same call.

First, equality is checked: both start from our parameters, statistics and replay, take three gradient steps on the same three
batches in float32, and must agree on every loss and on the gradient of one layer of each network. Then PyTorch's steps are
timed in our dtype with either encoder, and the faster one counts.

JAX takes most of a GPU's memory when it starts; if PyTorch then runs out, set XLA_PYTHON_CLIENT_MEM_FRACTION=.5.
"""

import dataclasses
import importlib
import math
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.config import OPTIONS, Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.ddpg.ddpg import make_ddpg
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.train_step import TrainStep
from jaxrl_vis.types import ReplayState, TrainState

STEPS = 3
"""Number of compared gradient steps."""
LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-3, 1e-3
"""Maximum relative difference of a loss, and of a gradient (by norm), in float32."""
DTYPE_TOLERANCE = 0.1
"""Maximum relative difference of the first critic loss between float32 and the timed dtype."""
COMPARED_LAYER = {"critic": "encoder/kernel_1", "actor": "head/hidden_0/kernel"}
"""Layer of each network whose gradients are compared."""


@dataclasses.dataclass(frozen=True)
class Reference:
    """Our first gradient steps in float32, and their starting point, as NumPy arrays.

    Attributes:
        parameters: Parameters by network and name, before the first step.
        statistics: (mean, scale) of observations, and of goals, [C, H, W] float32.
        choices: Episode, time and goal slot of each transition, [STEPS, 3, B] int64.
        losses: Losses of critic and actor, [STEPS, 2] float32.
        gradients: Gradients of the first step by network and name.
    """

    parameters: Mapping[str, Mapping[str, np.ndarray]]
    statistics: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    choices: np.ndarray
    losses: np.ndarray
    gradients: Mapping[str, Mapping[str, np.ndarray]]


def load() -> Any:
    """Import the learner, which needs PyTorch.

    Raises:
        RequestError: PyTorch is not installed, or does not see the GPU that JAX runs on.
    """
    try:
        learner = importlib.import_module("benchmarks.peers.torch.learner")
    except ImportError as error:
        raise RequestError(f"the peer torch needs PyTorch, which is not a dependency: pip install torch ({error})") from error
    if jax.default_backend() == "gpu" and not learner.torch.cuda.is_available():
        raise RequestError(f"the peer torch needs a PyTorch that sees the GPU; {learner.torch.__version__} does not")
    return learner


def by_name(tree: Any) -> dict[str, Any]:
    """Flatten nested dictionaries; return the leaves by path, such as encoder/kernel_0."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {"/".join(str(entry.key) for entry in path): leaf for path, leaf in leaves}


def distinguishable(train: TrainState, program: TrainStep, replay: ReplayState) -> TrainState:
    """Give one seed's learner distinguishable parts: targets that differ from the online networks, statistics of the replay.

    In a fresh learner, targets are copies and statistics are zero: a comparison would not notice if they were mixed up.
    """
    networks, target_key = program.networks, jax.random.key(7)
    fresh = {"actor": networks.init_actor(target_key), "critic": networks.init_critic(target_key)}
    images = program.replay.stacked(jax.tree.map(lambda leaf: leaf[:4] if leaf.ndim else leaf, replay))
    targets = {
        f"target_{name}": {part: tree[part] for part in getattr(train.agent, f"target_{name}")} for name, tree in fresh.items()
    }
    changes: dict[str, Any] = {"agent": train.agent.replace(**targets)}
    changes["normalizer"] = normalizer.update(train.normalizer, images)
    if train.goal_normalizer is not None:
        changes["goal_normalizer"] = normalizer.update(train.goal_normalizer, images[:, -1:])
    return train.replace(**changes)


def reference(program: TrainStep, train: TrainState, replay: ReplayState) -> Reference:
    """Take our `STEPS` gradient steps from `distinguishable`, in float32 with full-precision products.

    Args:
        program: Program; its configuration and sizes are used, but not its dtype.
        train, replay: State of one seed.

    Returns:
        The steps and their starting point.
    """
    config = program.config.replace(compute_dtype="float32")
    networks = dataclasses.replace(program.networks, config=config)
    algorithm = make_ddpg(networks, config, program.resolved)
    env = program.env
    as_goal = env.as_goal if env.frame_stack > 1 else None
    sampler = Sampler(config, program.resolved, program.replay, env.threshold, as_goal)

    def begin(train: TrainState, replay: ReplayState) -> tuple[TrainState, Choice, Any]:
        def choose(key: jax.Array) -> Choice:
            return sampler.choose(replay, key, jnp.zeros((), jnp.int32))

        train = distinguishable(train, program, replay)
        pairs = [
            (moments.mean, normalizer.scale(moments, config.network.normalizer_floor))
            for moments in (train.statistics.observations, train.statistics.goals)
        ]
        return train, jax.vmap(choose)(jax.random.split(jax.random.key(11), STEPS)), pairs

    def step(with_actor: bool, train: TrainState, replay: ReplayState, choice: Choice) -> tuple[TrainState, jax.Array, Any]:
        working = algorithm.begin(train.agent, train.statistics)
        # The actor's gradient is computed in every step, but applied only in steps that update the actor.
        gradients, metrics = algorithm.gradients(working, algorithm.prepare(working, sampler.batch(replay, choice)), True)
        losses = jnp.stack([metrics["train/critic_loss"], metrics["train/actor_loss"]])
        taken = gradients if with_actor else gradients._replace(actor=None)
        return train.replace(agent=algorithm.end(algorithm.apply(working, taken))), losses, gradients

    train, choices, statistics = jax.device_get(jaxrl_vis_envs.jit(begin, runs_once=True)(train, replay))
    now = train
    stepped = jaxrl_vis_envs.jit(step, static_argnums=0)
    losses, gradients = [], []
    with jax.default_matmul_precision("highest"):
        for index in range(STEPS):
            with_actor = (index + 1) % config.ddpg.actor_interval == 0
            choice = jax.tree.map(lambda leaf, index=index: leaf[index], choices)
            now, step_losses, step_gradients = jax.device_get(stepped(with_actor, now, replay, choice))
            losses.append(step_losses)
            gradients.append(step_gradients)
    names = ("actor", "critic", "target_actor", "target_critic")
    return Reference(
        parameters={name: by_name(getattr(train.agent, name)) for name in names},
        statistics=tuple(statistics),
        choices=np.stack([np.asarray(part, np.int64) for part in (*choices.indices, choices.goal_slot)], axis=1),
        losses=np.stack(losses),
        gradients={"critic": by_name(gradients[0].critic), "actor": by_name(gradients[0].actor)},
    )


def compare(reference: Reference, losses: np.ndarray, gradients: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Compare PyTorch's steps with ours; return the largest relative differences for the record.

    Args:
        reference: Our steps.
        losses: PyTorch's losses, [STEPS, 2] float32.
        gradients: Gradient of the `COMPARED_LAYER` of each network in the first step, shaped as ours.

    Raises:
        AssertionError: The differences exceed the tolerances.
    """
    difference = float(np.max(np.abs(losses - reference.losses) / np.maximum(np.abs(reference.losses), 1e-3)))
    differences = {"loss_difference": difference}
    for network, gradient in gradients.items():
        ours = reference.gradients[network][COMPARED_LAYER[network]]
        differences[f"{network}_gradient_difference"] = float(np.linalg.norm(gradient - ours) / np.linalg.norm(ours))
    bounds = {name: LOSS_TOLERANCE if name == "loss_difference" else GRADIENT_TOLERANCE for name in differences}
    if not all(differences[name] <= bound for name, bound in bounds.items()):  # fails for NaN, too
        raise AssertionError(
            f"PyTorch does not compute what we do: {differences}, losses {losses.tolist()}, {reference.losses.tolist()}"
        )
    return differences


def _rules(learner: Any, program: TrainStep, train: TrainState, encoder: str, dtype: Any) -> Any:
    """Make `learner.Rules` from a configuration; the parameters determine which networks have an encoder."""
    config, resolved = program.config, program.resolved
    numbers = {**config.flat(), **dataclasses.asdict(resolved), "threshold": float(program.env.threshold)}
    known = {
        "encoder": encoder,
        "dtype": dtype,
        "levels": len(config.network.encoder_filters),
        "hidden": len(config.network.hidden_sizes),
        "shared_encoder": "encoder" not in train.agent.actor,
        "target_encoder": "encoder" in train.agent.target_critic,
        "actor_interval": numbers.get("actor_interval", 1),
        "frame_stack": program.env.frame_stack,
    }
    names = [field.name for field in dataclasses.fields(learner.Rules)]
    return learner.Rules(**{name: known[name] if name in known else numbers[name] for name in names})


class _Peer:
    """PyTorch's learners with our parameters and our replay.

    Args:
        program: Our program.
        train, replay: State of one seed.
    """

    def __init__(self, program: TrainStep, train: TrainState, replay: ReplayState):
        self._module = load()
        self._torch = self._module.torch
        self.version, self.encoders = str(self._torch.__version__), self._module.layout.ENCODERS
        self.device = "cpu" if jax.default_backend() == "cpu" else "cuda"
        self._program, self._train = program, train
        self.reference = reference(program, train, replay)
        episodes = replay.episodes
        leaves = program.replay.stacked(replay), episodes.states, episodes.actions
        self._episodes = [np.asarray(leaf) for leaf in leaves]

    def replay(self, encoder: str) -> Any:
        """Convert our replay to a `learner.Replay` for one of `encoders`."""
        return self._module.Replay(*self._episodes, self._rules(encoder, "float32"), self.device)

    def _rules(self, encoder: str, dtype: str) -> Any:
        return _rules(self._module, self._program, self._train, encoder, getattr(self._torch, dtype))

    def _learner(self, replay: Any, encoder: str, dtype: str) -> Any:
        """Make a `learner.Learner` before its first step."""
        tensor = self._torch.from_numpy
        networks = {
            network: {name: tensor(np.array(leaf)) for name, leaf in parameters.items()}
            for network, parameters in self.reference.parameters.items()
        }
        statistics = [tuple(tensor(np.array(plane)) for plane in pair) for pair in self.reference.statistics]
        return self._module.Learner(self._rules(encoder, dtype), networks, statistics, replay, self.device)

    def check(self, replay: Any, encoder: str) -> dict[str, float]:
        """Compare the first steps in float32; see `compare`."""
        torch, learner = self._torch, self._learner(replay, encoder, "float32")
        choices = torch.from_numpy(self.reference.choices).to(self.device)
        losses, slopes = [], {}
        precise = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
        for choice in choices:
            next_updates = learner.next_updates()
            critic_error, policy_loss, critic, actor = learner.gradients(choice)
            losses.append([float(critic_error), float(policy_loss)])
            for network, gradients in (("critic", critic), ("actor", actor)):
                name = COMPARED_LAYER[network]
                slope = self._module.layout.to_ours(name, gradients[name], encoder)
                slopes.setdefault(network, slope.cpu().numpy())
            learner.apply(critic, actor if next_updates[0] else {}, next_updates[1])
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = precise
        return compare(self.reference, np.asarray(losses), slopes)

    def time(self, replay: Any, encoder: str, dtype: str, steps: int, repeats: int) -> tuple[Any, float]:
        """Time one call of ``steps`` gradient steps.

        Args:
            replay: Replay from `replay`, for the same encoder.
            encoder: One of `encoders`.
            dtype: Name of the networks' compute dtype.
            steps: Gradient steps per call.
            repeats: Number of timed calls.

        Returns:
            `Timing` of a call, and the duration of compilation, s.

        Raises:
            AssertionError: The first critic loss differs from ours by more than rounding, or a network does not change.
            FloatingPointError: A loss is not finite.
        """
        torch = self._torch
        torch.set_float32_matmul_precision("high")  # the default of XLA
        learner = self._learner(replay, encoder, dtype)
        first = float(learner.gradients(torch.from_numpy(self.reference.choices[0]).to(self.device))[0])
        expected = float(self.reference.losses[0, 0])
        if not math.isclose(first, expected, rel_tol=DTYPE_TOLERANCE):
            raise AssertionError(f"in {dtype} PyTorch's critic loss is {first}, in float32 {expected}")
        before = {network: learner.networks[network][name].clone() for network, name in COMPARED_LAYER.items()}
        started = time.perf_counter()
        compiled = self._module.Compiled(learner, steps)
        self._synchronize(None)
        compile_s = time.perf_counter() - started
        timing = measure_time(compiled, repeats, wait=self._synchronize)
        if not bool(torch.isfinite(learner.losses).all()):
            raise FloatingPointError("PyTorch's losses are not finite")
        for network, name in COMPARED_LAYER.items():
            if torch.equal(before[network], learner.networks[network][name]):
                raise AssertionError(f"PyTorch's {network} did not move: no gradient step was taken")
        return timing, compile_s

    def _synchronize(self, _: Any) -> None:
        if self.device != "cpu":
            self._torch.cuda.synchronize()


def check_config(program: TrainStep) -> None:
    """Check that the peer has every feature of a configuration.

    Raises:
        RequestError: Rewards are not the oracle's, observations are not images, or the peer lacks an option that is set.
    """
    config: Config = program.config
    for name in ("random_shift", "n_step", "trivial_goals", "replay_mean_age"):
        if config.value(name) != OPTIONS[name].default:
            raise RequestError(f"the peer torch does not have {name}: leave it at {OPTIONS[name].default}")
    if config.reward.method != "oracle" or not program.networks.sees_images:
        raise RequestError("the peer torch learns from images with the method oracle: choose a Visual environment")


def measure(program: TrainStep, train: TrainState, replay: ReplayState, repeats: int, ours: Measurement) -> Measurement:
    """Measure PyTorch's gradient steps per second with the faster encoder.

    Args:
        program: Our program, one call of which takes ``updates_per_iteration`` steps.
        train, replay: State of one seed, without the seed's axis.
        repeats: Maximum number of timed repeats.
        ours: Our measurement for the same configuration.

    Raises:
        AssertionError: PyTorch does not compute what we do.
    """
    peer = _Peer(program, train, replay)
    dtype, steps = str(program.networks.dtype), program.updates_per_iteration
    figures: dict[str, tuple[float, dict[str, Any]]] = {}
    for encoder in peer.encoders:
        episodes = peer.replay(encoder)
        agreement = {name: float(f"{value:.2g}") for name, value in peer.check(episodes, encoder).items()}
        timing, compile_s = peer.time(episodes, encoder, dtype, steps, repeats)
        figures[encoder] = steps / timing.median_s, timing.details(compile_s, **agreement)
        print(f"    PyTorch, {encoder}: {figures[encoder][0]:,.0f} updates/s, compiled in {compile_s:.0f} s", flush=True)
    fastest = max(figures, key=lambda encoder: figures[encoder][0])
    rate, details = figures[fastest]
    rates = {f"{encoder}_per_s": round(value, 1) for encoder, (value, _) in figures.items()}
    return Measurement(
        name="update/peer_torch",
        value=rate,
        unit="updates/s",
        config=ours.config,
        details={**details, "ours_over_peer": round(ours.value / rate, 2), "encoder": fastest, **rates, "torch": peer.version},
    )
