"""A configuration and its compiled programs: everything that a run, an evaluation or a notebook executes on the device.

All of it is compiled before training starts, so that the end of a run, where signals and full disks come, compiles nothing.

A training iteration is two programs, which XLA compiles side by side (`jaxrl_vis.learner.parts`), and a CPU evaluates with one
of these, too.
"""

import concurrent.futures
import contextlib
import functools
import gc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis import processes
from jaxrl_vis.config import Config
from jaxrl_vis.devices import cache_fault, default_cache, enable_compilation_cache
from jaxrl_vis.learner.parts import played_spec
from jaxrl_vis.learner.rollout import Exploration
from jaxrl_vis.report import videos
from jaxrl_vis.run.arrays import to_host
from jaxrl_vis.run.kept_programs import CompiledOfLeaves, KeptPrograms, fingerprint
from jaxrl_vis.run.nonfinite import broken_leaves
from jaxrl_vis.run.pending import Pending, stacked
from jaxrl_vis.run.side_by_side import SideBySide
from jaxrl_vis.run.signals import shield_this_thread
from jaxrl_vis.types import Episodes, LoopState, Metrics, TrainState
from jaxrl_vis_envs.compiling.compilation import assume_kernels_compile, failed_kernels, tracing_for_default_device

# Evaluation draws from a key of its own, the same at every evaluation and for every seed.
_EVALUATION_SEED = 2**31 - 1
# What takes longest to compile comes first: it compiles while the others are traced.
_WHOLE = ("train_iteration", "evaluate", "init", "broken_leaves")
_PARTS = ("play", "learn", "keys")
_IN_PARTS = ("play", "learn", "evaluate", "init", "broken_leaves", "keys")
# Those that take long to trace, and their options.
_KEPT: dict[str, dict[str, Any]] = {
    "init": {"runs_once": True},
    "train_iteration": {"donate_argnums": 0},
    "evaluate": {},
    "play": {},
    "learn": {"donate_argnums": 0},
}
# Those that return metrics, and at which place.
_METRICS = {"train_iteration": 1, "learn": 1, "evaluate": 0}
# Trees that programs return, which are lists of their leaves in what is kept.
_TREES = (LoopState, Episodes)
# Of objects made since the last collection of garbage; Python's own default is 700.
_OBJECTS_WHILE_TRACING = 100_000


@contextlib.contextmanager
def rarely_collecting_garbage() -> Iterator[None]:
    """For tracing: it makes millions of objects and next to no garbage, and looking for that takes an eighth of its time."""
    before = gc.get_threshold()
    gc.set_threshold(max(before[0], _OBJECTS_WHILE_TRACING) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _without_trees(results: Any) -> Any:
    """Results of a program, with the leaves of each of `_TREES`, a list, in its place."""

    def leaves(part: Any) -> Any:
        return jax.tree.leaves(part) if isinstance(part, _TREES) else part

    return jax.tree.map(leaves, results, is_leaf=lambda part: isinstance(part, _TREES))


def _without_layout(shape: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """What a compiled program says of an array that it returns, less how it lies in the device's memory."""
    return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=shape.sharding)


class Programs:
    """What a configuration executes. Nothing is compiled or allocated until it is called or `compile` is.

    Args:
        config: The run.
        program: What `jaxrl_vis.learner.train_step.make_train_step` returns, or anything with the same attributes.
        keep: Keep on disk what was traced, and trace nothing that is kept there: `kept_programs` says when that is right. Only
            where one device computes.
        cache: Keep on disk what was compiled, too.

    Attributes:
        config: The run.
        program: The jitted functions and their sizes.
        env: The environment.
        layout: Where seeds, and the parts of learners, lie.
        seeds: The seeds, in the order of the seed axis.
        side_by_side: What trains in parts; None where an iteration is one program.
    """

    def __init__(self, config: Config, program: Any, keep: bool = False, cache: bool = True):
        self.config, self.program, self.env = config, program, program.env
        self.layout = program.layout
        self.seeds = range(config.seed, config.seed + config.seeds)
        self._compiled: dict[str, Any] = {}
        self._stacks: dict[frozenset[str], Any] = {}
        self._kept: KeptPrograms | None = None
        self._may_keep, self._caches = keep and cache and self.layout.mesh is None, cache
        parts = program.parts
        self.side_by_side = None if parts is None else SideBySide(self.env, parts, self.compiled)
        self._evaluator = self.side_by_side if parts is not None and parts.plays_any else None

    @functools.cached_property
    def run_keys(self) -> jax.Array:
        """[S] typed keys: seed i of a run starts from ``jax.random.key(config.seed + i)``."""
        return self.layout.put(jnp.stack([jax.random.key(seed) for seed in self.seeds]), self.layout.by_seed)

    @functools.cached_property
    def evaluation_key(self) -> jax.Array:
        """[] the typed key that draws the episodes of every evaluation."""
        return self.layout.put(jax.random.key(_EVALUATION_SEED), self.layout.everywhere)

    @functools.cached_property
    def shapes(self) -> LoopState:
        """Shapes and types of the loop state, and where it lies; traced, not allocated."""
        with tracing_for_default_device(), assume_kernels_compile():  # as it will be compiled, so that it is traced once
            shapes = jax.eval_shape(self.program.init, self.run_keys)
        return self.layout.with_shardings(shapes, self.layout.loop)

    @functools.cached_property
    def shows_images(self) -> bool:
        """Whether what the robot sees can be shown in a video."""
        _, episodes, slots, *image = jax.eval_shape(self.layout.unfolded, self.shapes.replay).episodes.observations.shape
        return videos.shows_images((episodes, slots, *image))

    @property
    def image_seconds(self) -> float:
        """How long an image of the video is shown, s: as long as it lasted, but not too fast to follow."""
        return max(0.04, float(self.env.control_period))

    @property
    def evaluates_ahead(self) -> bool:
        """Whether `evaluate` returns before the device has done its work."""
        return self._evaluator is None

    @property
    def names(self) -> tuple[str, ...]:
        """The programs that a run needs."""
        names = _WHOLE if self.side_by_side is None else _IN_PARTS
        return tuple(name for name in names if name != "evaluate" or self._evaluator is None)

    def compile(self, meanwhile: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Compiles everything that a run needs, side by side, the small operations of saving and evaluating included.

        Each function is traced once, here, and what was compiled here is what runs later.

        Args:
            meanwhile: Called when all is traced, and XLA has the processor to itself.

        Returns:
            The compiled programs by name.
        """
        self._those(self.names, meanwhile)
        return dict(self._compiled)

    def says_of_cache(self) -> str:
        """Describe what the next start will find in the cache of what is compiled now."""
        folder, fault = enable_compilation_cache(), cache_fault()
        if fault is not None:
            return f"as will every start: {fault}"
        return f"once; the next start finds it in {'the cache' if folder == str(default_cache()) else folder}"

    def _those(self, names: Sequence[str], meanwhile: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Programs by name; those that are not compiled yet are now."""
        if missing := [name for name in names if name not in self._compiled]:
            self._make(missing, meanwhile)
        return {name: self._compiled[name] for name in names}

    def _make(self, names: Sequence[str], meanwhile: Callable[[], None] = lambda: None) -> None:
        """Compiles programs, which then are `_compiled`."""
        cache = enable_compilation_cache() if self._caches else ""
        if cache and self._may_keep and (found := fingerprint(self.config, self.env)):
            self._kept = KeptPrograms(Path(cache) / "programs", found)
            try:
                with assume_kernels_compile():
                    self._compiled |= self._all(names, meanwhile)
                self._kept.write()
                return
            except Exception:  # whatever is wrong with them, or with a kernel in them, is found below, without
                self._kept.forget()
                self._kept, self._may_keep = None, False
        try:
            with assume_kernels_compile():
                self._compiled |= self._all(names, meanwhile)
        except Exception:
            if not failed_kernels():
                raise
            self._compiled |= self._all(names, meanwhile)

    def _all(self, names: Sequence[str], meanwhile: Callable[[], None]) -> dict[str, Any]:
        # Tracing is Python and goes one by one; XLA compiles without the interpreter's lock, meanwhile.
        with concurrent.futures.ThreadPoolExecutor(len(names), initializer=shield_this_thread) as pool:
            futures = {name: pool.submit(self.lower(name).compile) for name in names}
            if "init" in names and not processes.are_several():
                # Taking keys apart, as saving does, is a program, too.
                to_host({"keys": self.run_keys, "evaluation": self.evaluation_key}, copy=True)
            meanwhile()
            compiled = {name: future.result() for name, future in futures.items()}
        for name, place in _METRICS.items():
            if name in compiled:
                metrics = {key: _without_layout(each) for key, each in compiled[name].out_info[place].items()}
                self._stacks[frozenset(metrics)] = stacked.lower(metrics).compile()
        if self._kept is None:
            return compiled
        return {name: self._of_trees(name, each) if name in _KEPT else each for name, each in compiled.items()}

    def lower(self, name: str) -> Any:
        """A program as JAX has lowered it, to be compiled."""
        if name == "broken_leaves":
            return jax.jit(broken_leaves).lower(self.shapes)
        arguments = self._arguments(name)
        function = getattr(self.program.parts if name in _PARTS else self.program, name)
        with tracing_for_default_device(), rarely_collecting_garbage():
            if self._kept is None or name not in _KEPT:
                return function.lower(*arguments)
            return self._kept.lower(name, function, arguments, _without_trees, **_KEPT[name])

    def _arguments(self, name: str) -> tuple:
        """Shapes of what a program is called with."""
        if name == "init":
            return (self.run_keys,)
        shapes = self.shapes
        if name == "train_iteration":
            return (shapes,)
        if name == "evaluate":
            return shapes.train, self.evaluation_key
        if name == "keys":
            return shapes.key, shapes.iteration
        number: Any = jax.ShapeDtypeStruct((), jnp.float32)
        if name == "play":
            return shapes.train, shapes.key, jax.ShapeDtypeStruct((), jnp.int32), Exploration(number, number)
        parts = self.program.parts
        played = played_spec(self.env, parts.size, len(self.seeds))
        return shapes, [self.layout.with_shardings(played, self.layout.by_environment)] * parts.count

    def _of_trees(self, name: str, compiled: Any) -> CompiledOfLeaves:
        """A kept program as the program that it was traced from: its loop states are trees again, not lists."""
        tree = jax.tree.structure(Episodes(0, 0, 0) if name == "play" else self.shapes)  # type: ignore[arg-type]

        def restored(part: Any) -> Any:
            return jax.tree.unflatten(tree, part) if isinstance(part, list) else part

        def restore(results: Any) -> Any:
            return tuple(map(restored, results)) if isinstance(results, tuple) else restored(results)

        return CompiledOfLeaves(compiled, restore)

    def compiled(self, name: str) -> Any:
        """One compiled program, by its name in `compile`."""
        return self._those([name])[name]

    def init(self, keys: jax.Array) -> LoopState:
        """A fresh learner with an empty replay, for each of the typed keys [S]."""
        return self.compiled("init")(self.layout.put(keys, self.layout.by_seed))

    def of_evaluation(self) -> dict[str, Any]:
        """The compiled programs that an evaluation needs, by name."""
        return self._those(["evaluate"] if self._evaluator is None else ["play"])

    def of_training(self) -> dict[str, Any]:
        """The compiled programs that an iteration needs, by name."""
        return self._those(["train_iteration"] if self.side_by_side is None else _PARTS)

    def train_iteration(self, loop: LoopState) -> tuple[LoopState, Metrics]:
        """One iteration; ``loop`` is donated. See `Trainer.train_iteration`."""
        compiled = self.of_training()  # all of them before the first is called, so that they are compiled side by side
        if self.side_by_side is not None:
            return self.side_by_side.train_iteration(loop)
        return compiled["train_iteration"](loop)

    def evaluate(self, train: TrainState, key: jax.Array | None = None) -> tuple[Metrics, dict[str, jax.Array]]:
        """Metrics of the policy without noise, [S] float32, and images of the first few episodes of every seed.

        Args:
            train: The learner, [S, ...].
            key: Draws the episodes; None: always the same ones.
        """
        chosen: Any = self.evaluation_key if key is None else self.layout.put(key, self.layout.everywhere)
        if self._evaluator is not None:
            keys = jnp.stack([chosen] * len(self.seeds))
            return self._evaluator.evaluate(train, keys, self.config.eval_episodes)
        return self.compiled("evaluate")(train, chosen)

    def pending(self, metrics: Metrics) -> Pending:
        """What `train_iteration` or `evaluate` returned, to be read by the host; nothing is compiled for it."""
        return Pending(metrics, self._stacks.get(frozenset(metrics), stacked))

    def broken_leaves(self, loop: LoopState) -> list[str]:
        """Names of the floating-point leaves of the loop state that hold a NaN or an infinity."""
        return [name for name, is_broken in jax.device_get(self.compiled("broken_leaves")(loop)).items() if is_broken]
