"""Compiled programs of a configuration: everything that a run, an evaluation or a notebook executes on the device.

All of it is compiled before training starts, so that nothing is compiled at the end of a run, which a signal may have caused.

A training iteration is ``keys``, which is tiny, and two programs that XLA compiles in parallel, ``play`` and ``learn``
(`jaxrl_vis.learner.train_step`).
A CPU also evaluates with ``play``; other devices have a separate program for evaluation.
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

from jaxrl_vis.config import Config
from jaxrl_vis.host import distributed
from jaxrl_vis.host.devices import cache_fault, default_cache, enable_compilation_cache
from jaxrl_vis.learner.acting.evaluate import Evaluation
from jaxrl_vis.learner.acting.rollout import NO_EXPLORATION, Exploration
from jaxrl_vis.learner.iteration import Learned
from jaxrl_vis.learner.train_step import JIT_OPTIONS
from jaxrl_vis.report import videos
from jaxrl_vis.run.compiled.nonfinite import nonfinite_leaves
from jaxrl_vis.run.compiled.pending import PendingMetrics, stack_metrics
from jaxrl_vis.run.compiled.threaded_rollout import ThreadedRollout
from jaxrl_vis.run.compiled.trace_cache import TraceCache, fingerprint
from jaxrl_vis.run.signals import shield_this_thread
from jaxrl_vis.run.storage.arrays import to_host
from jaxrl_vis.types import LoopState, Metrics, TrainState
from jaxrl_vis_envs.compiling.compilation import any_kernel_failed, assume_kernels_compile, tracing_for_default_device

# Seed of the evaluation key, which is the same at every evaluation and for every seed.
_EVALUATION_SEED = 2**31 - 1
_TRAINING = ("play", "learn", "keys")
# Programs that are slow to trace, which are cached.
_CACHED = ("init", "play", "learn", "evaluate")
# Garbage collection threshold (allocations since the last collection) while tracing; Python's default is 700.
_OBJECTS_WHILE_TRACING = 100_000


@contextlib.contextmanager
def rarely_collecting_garbage() -> Iterator[None]:
    """Collect garbage less often while tracing, which creates millions of objects and little garbage: saves 1/8 of the time."""
    before = gc.get_threshold()
    gc.set_threshold(max(before[0], _OBJECTS_WHILE_TRACING) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


class Programs:
    """Programs of a configuration. Nothing is compiled or allocated until it is called or `compile` is.

    Args:
        config: Configuration of the run.
        program: From `jaxrl_vis.learner.train_step.make_train_step`, or anything with the same attributes.
        keep: Whether to cache traced programs on disk, if permitted (see `trace_cache`); ignored on several devices.
        cache: Whether to cache compiled programs on disk; without, traced ones are not cached either.

    Attributes:
        config: Configuration of the run.
        program: The jitted functions and their sizes.
        env: The environment.
        layout: Placement of seeds and shards.
        seeds: The seeds, in the order of the seed axis.
    """

    def __init__(self, config: Config, program: Any, keep: bool = False, cache: bool = True):
        self.config, self.program, self.env = config, program, program.env
        self.layout = program.layout
        self.seeds = range(config.run.seed, config.run.seed + config.run.seeds)
        self._compiled: dict[str, Any] = {}
        self._stacks: dict[frozenset[str], Any] = {}
        self._traces: TraceCache | None = None
        self._may_keep, self._caches = keep and cache and self.layout.mesh is None, cache
        self._rollout = ThreadedRollout(program.part_size)

    @functools.cached_property
    def run_keys(self) -> jax.Array:
        """[S] typed keys: seed i of a run starts from ``jax.random.key(config.run.seed + i)``."""
        return self.layout.put(jnp.stack([jax.random.key(seed) for seed in self.seeds]), self.layout.by_seed)

    @functools.cached_property
    def evaluation_key(self) -> jax.Array:
        """Typed key that determines the episodes of every evaluation, []."""
        return self.layout.put(jax.random.key(_EVALUATION_SEED), self.layout.replicated)

    @functools.cached_property
    def shapes(self) -> LoopState:
        """Shapes, dtypes and shardings of the loop state; traced, not allocated."""
        with tracing_for_default_device(), assume_kernels_compile():  # as in compilation, so that it is traced only once
            shapes = jax.eval_shape(self.program.init, self.run_keys)
        return self.layout.with_shardings(shapes, self.layout.loop)

    @functools.cached_property
    def shows_images(self) -> bool:
        """True if observations can be shown in a video."""
        replay = jax.eval_shape(jax.vmap(self.layout.unfold_replay), self.shapes.replay)
        _, episodes, slots, *image = replay.episodes.observations.shape
        return videos.shows_images((episodes, slots, *image))

    @property
    def image_seconds(self) -> float:
        """Duration of a video frame in seconds: the control period, but at least 0.04 s."""
        return max(0.04, float(self.env.control_period))

    @property
    def evaluates_ahead(self) -> bool:
        """True if `evaluate` is asynchronous, i.e. returns before the device has finished."""
        return not self.program.plays_parts

    @property
    def _evaluation(self) -> tuple[str, ...]:
        return ("play",) if self.program.plays_parts else ("evaluate",)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the programs that a run needs, slowest to compile first: they compile while others are traced."""
        return tuple(dict.fromkeys(("play", "learn", *self._evaluation, "init", "nonfinite_leaves", "keys")))

    def compile(self, names: Sequence[str] | None = None, concurrent_work: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Compile programs in parallel, including the small operations of saving and evaluating.

        Each function is traced once, here, and the programs compiled here are the ones that run later.

        Args:
            names: Names of the programs; None for all that a run needs. Compiled ones are skipped.
            concurrent_work: Called after tracing, while XLA compiles.

        Returns:
            All programs compiled so far, by name.
        """
        missing = [name for name in names or self.names if name not in self._compiled]
        traces, trusting = self._open_traces() if missing else None, True
        while missing:
            try:
                # Tracing is Python and sequential; meanwhile, XLA compiles without the interpreter's lock.
                with (
                    concurrent.futures.ThreadPoolExecutor(len(missing), initializer=shield_this_thread) as pool,
                    assume_kernels_compile() if trusting else contextlib.nullcontext(),
                ):
                    futures = {}
                    for name in missing:
                        function, arguments = self._call(name)
                        with tracing_for_default_device(), rarely_collecting_garbage():
                            if traces is not None and name in _CACHED:
                                lowered = traces.lower(name, function, arguments)
                            else:
                                lowered = function.lower(*arguments)
                        futures[name] = pool.submit(lowered.compile)
                    self._run_concurrent_work(missing, concurrent_work)
                    self._store({name: future.result() for name, future in futures.items()})
                if traces is not None:
                    traces.write()
                break
            except Exception:
                if traces is not None:  # the fault may lie in the cached programs, or in their kernels: retry without the cache
                    traces.forget()
                    traces, self._may_keep = None, False
                elif trusting and any_kernel_failed():
                    trusting = False
                else:
                    raise
        return dict(self._compiled)

    def _open_traces(self) -> TraceCache | None:
        """Open the cache of programs traced for this configuration; None if nothing is to be cached."""
        cache = enable_compilation_cache() if self._caches else ""
        identity = fingerprint(self.config, self.env, self.shapes.train) if cache and self._may_keep else None
        if identity is None:
            return None
        return TraceCache(Path(cache) / "programs", identity, self.shapes, JIT_OPTIONS)

    def _run_concurrent_work(self, names: Sequence[str], concurrent_work: Callable[[], None]) -> None:
        """Do all work that can overlap with XLA's compilation."""
        if "init" in names and not distributed.is_multi_process():
            # Extracting the data of keys, as in saving, is also a compiled program.
            to_host({"keys": self.run_keys, "evaluation": self.evaluation_key}, copy=True)
        concurrent_work()

    def _store(self, compiled: dict[str, Any]) -> None:
        """Store compiled programs, and compile the stacking of their metrics."""
        for program in compiled.values():
            if metrics := getattr(program.out_info, "metrics", None):
                shapes = {name: _without_layout(shape) for name, shape in metrics.items()}
                self._stacks[frozenset(shapes)] = stack_metrics.lower(shapes).compile()
        self._compiled |= compiled

    def _call(self, name: str) -> tuple[Any, tuple]:
        """Return a program's jitted function and the shapes of its arguments."""
        if name == "init":
            return self.program.init, (self.run_keys,)
        shapes, number = self.shapes, jax.ShapeDtypeStruct((), jnp.float32)
        first, noise = jax.ShapeDtypeStruct((), jnp.int32), Exploration(number, number)  # type: ignore[arg-type]
        calls: dict[str, tuple[Any, tuple]] = {
            "nonfinite_leaves": (jax.jit(nonfinite_leaves), (shapes,)),
            "keys": (self.program.keys, (shapes.key, shapes.iteration)),
            "play": (self.program.play, (shapes.train, shapes.key, first, noise)),
            "learn": (self.program.learn, (shapes, self.program.parts_spec)),
            "evaluate": (self.program.evaluate, (shapes.train, self.evaluation_key)),
        }
        return calls[name]

    def compiled(self, name: str) -> Any:
        """Return a compiled program by its name in `compile`."""
        return self.compile([name])[name]

    def init(self, keys: jax.Array) -> LoopState:
        """Initialise a learner with an empty replay for each of the typed keys [S]."""
        return self.compiled("init")(self.layout.put(keys, self.layout.by_seed))

    def evaluation_programs(self) -> dict[str, Any]:
        """Return the compiled programs that an evaluation needs, by name."""
        return {name: self.compile(self._evaluation)[name] for name in self._evaluation}

    def training_programs(self) -> dict[str, Any]:
        """Return the compiled programs that an iteration needs, by name."""
        compiled = self.compile(_TRAINING)
        return {name: compiled[name] for name in _TRAINING}

    def play(self, train: TrainState, keys: jax.Array) -> list[Any]:
        """Run a training rollout with typed keys [S]; return its parts in order (`rollout_parts.PartResult`)."""
        count, exploration = self.config.run.num_envs, self.program.exploration
        return self._rollout.play(self.compiled("play"), train, keys, count, exploration)

    def train_iteration(self, loop: LoopState) -> tuple[LoopState, Metrics]:
        """Run one iteration; ``loop`` is donated. See `Trainer.train_iteration`."""
        compiled = self.training_programs()  # before the first is called, so that they are compiled in parallel
        keys = compiled["keys"](loop.key, loop.iteration)
        learned: Learned = compiled["learn"](loop, self.play(loop.train, keys))
        return learned.loop, learned.metrics

    def evaluate(self, train: TrainState, key: jax.Array | None = None) -> Evaluation:
        """Evaluate the policy without noise; return metrics, [S] float32, and images of the first few episodes of every seed.

        Args:
            train: The learner, [S, ...].
            key: Typed key [] that determines the episodes; None for `evaluation_key`, with the same episodes at every call.
        """
        chosen: Any = self.evaluation_key if key is None else self.layout.put(key, self.layout.replicated)
        if not self.program.plays_parts:
            return self.compiled("evaluate")(train, chosen)
        keys = jnp.stack([chosen] * len(self.seeds))
        return self._rollout.evaluate(self.compiled("play"), train, keys, self.config.run.eval_episodes, self.env.frame_stack)

    def record(self, train: TrainState, key: jax.Array, count: int) -> list[Any]:
        """Roll out episodes without exploration noise, with the program of training rollouts; return their parts
        (`rollout_parts.PartResult`).

        Args:
            train: The learner, [S, ...].
            key: Typed key [] that determines the episodes, which are the same for all seeds.
            count: Episodes of each learner, rounded up to whole parts.
        """
        program, size = self.compiled("play"), self.program.part_size
        if self.program.plays_parts:
            keys = jnp.stack([key] * len(self.seeds))
            return self._rollout.play(program, train, keys, count, NO_EXPLORATION)
        parts = []
        for number in range(-(-count // size)):  # the program supports only whole rollouts
            keys = self.layout.put(jnp.stack([jax.random.fold_in(key, number)] * len(self.seeds)), self.layout.by_seed)
            parts += self._rollout.play(program, train, keys, size, NO_EXPLORATION)
        return parts

    def pending(self, metrics: Metrics) -> PendingMetrics:
        """Prepare metrics of `train_iteration` or `evaluate` for reading by the host, without compiling anything."""
        return PendingMetrics(metrics, self._stacks.get(frozenset(metrics), stack_metrics))

    def nonfinite_leaves(self, loop: LoopState) -> list[str]:
        """List the floating-point leaves of the loop state that hold a NaN or an infinity."""
        return [name for name, is_broken in jax.device_get(self.compiled("nonfinite_leaves")(loop)).items() if is_broken]

    def cache_message(self) -> str:
        """Describe, for messages, whether the next start will find the programs compiled now in the cache."""
        folder, fault = enable_compilation_cache(), cache_fault()
        if fault is not None:
            return f"as will every start: {fault}"
        return f"once; the next start finds it in {'the cache' if folder == str(default_cache()) else folder}"


def _without_layout(shape: Any) -> jax.ShapeDtypeStruct:
    """Strip the memory layout from the shape of a compiled program's result."""
    return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=shape.sharding)
