"""Training from Python.

    trainer = make_trainer(config)
    loop = trainer.init(jax.random.key(0))
    loop, metrics = trainer.train_iteration(loop)       # a rollout and gradient steps, in a loop of your own
    for report in trainer.run(): ...                    # or a complete run, with logs, evaluations, checkpoints and images

Trained runs are loaded by `jaxrl_vis.run.trained.restored_run`.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.errors import NonFiniteError, RequestError, Terminated
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache, silence_cache_warnings, start_devices
from jaxrl_vis.host.plugins import custom_names
from jaxrl_vis.host.streams import safe_streams
from jaxrl_vis.learner.environment import locate_env, make_env
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.loggers import group
from jaxrl_vis.run.loop import RunLoop
from jaxrl_vis.run.reports import Callback, Report
from jaxrl_vis.run.signals import shielded_children
from jaxrl_vis.run.storage.folder import RunFolder, default_folder, read_log
from jaxrl_vis.types import LoopState, Metrics, TrainState
from jaxrl_vis_envs.registry import is_built_in

__all__ = ["NonFiniteError", "Report", "Terminated", "Trainer", "enable_compilation_cache", "make_trainer"]


class Trainer:
    """Configuration, its programs, and the run folder. Nothing is compiled, allocated or written at first.

    Args:
        config: Configuration of the run.
        program: From `jaxrl_vis.learner.train_step.make_train_step`, or anything with the same attributes.
        run_dir: Folder of the files of `run`; None for `jaxrl_vis.run.storage.folder.default_folder`.
        resume: Whether to continue the run in ``run_dir``.
        overwrite: Whether to delete the run in ``run_dir`` and start again.
        log: Loggers in addition to metrics.jsonl: ``tensorboard``, ``wandb``. None: those of the resumed run.
        cache_programs: Whether to cache traced programs between processes (`jaxrl_vis.run.compiled.trace_cache`).

    Attributes:
        config: Configuration of the run.
        env: The environment.
        programs: Programs of the configuration, each compiled at its first use.
        folder: The run folder.
        seeds: The seeds, in the order of the seed axis.

    Raises:
        RequestError: ``run_dir`` cannot be used for ``config``, or a logger is unknown or its library is missing.
    """

    def __init__(
        self,
        config: Config,
        program: Any,
        run_dir: Path | str | None = None,
        resume: bool = False,
        overwrite: bool = False,
        log: Sequence[str] | None = None,
        cache_programs: bool = False,
    ):
        self.config, self.programs = config, Programs(config, program, cache_programs)
        self.env, self.seeds = self.programs.env, self.programs.seeds
        self.folder = RunFolder(default_folder(config) if run_dir is None else Path(run_dir))
        self._resume, self._overwrite = resume, overwrite
        if run_dir is not None:
            self.folder.check(config, resume, overwrite)
        if log is None:
            log = read_log(self.folder.path) if resume else ()
        group.check(log)
        self._log = tuple(log)

    @property
    def program(self) -> Any:
        """Jitted functions, as passed to the constructor."""
        return self.programs.program

    @property
    def run_keys(self) -> jax.Array:
        """[S] typed keys: seed i of `run` starts from ``jax.random.key(config.run.seed + i)``."""
        return self.programs.run_keys

    @property
    def shapes(self) -> LoopState:
        """Shapes and dtypes of the loop state; traced, not allocated."""
        return self.programs.shapes

    def compile(self) -> dict[str, Any]:
        """Compile everything that a run needs, in parallel, and return the programs by name; `run` does so by itself."""
        return self.programs.compile()

    def init(self, key: jax.Array) -> LoopState:
        """Initialise a learner with an empty replay.

        Args:
            key: Typed key. With one seed it is that seed's key, so `run` with ``seed=0`` starts from
                ``init(jax.random.key(0))``; with several it is split. Or [S] keys, one per seed.

        Raises:
            RequestError: ``key`` is an integer, an untyped key, or has the wrong number of seeds.
        """
        _check_key("init", key)
        if key.ndim == 0:
            key = key[None] if self.config.run.seeds == 1 else jax.random.split(key, self.config.run.seeds)
        if key.shape != (self.config.run.seeds,):
            raise RequestError(f"init takes one key, or one for each of {self.config.run.seeds} seeds, not {key.shape} of them")
        return self.programs.init(key)

    def train_iteration(self, loop: LoopState) -> tuple[LoopState, Metrics]:
        """Run one iteration: a rollout, then gradient steps. ``loop`` is donated: use the returned one.

        Returns:
            The new state, and metrics of [S] float32 that the device may still be working on.
        """
        return self.programs.train_iteration(loop)

    def evaluate(self, loop: LoopState | TrainState, key: jax.Array | None = None) -> Metrics:
        """Evaluate the policy without noise: ``eval/success``, ``eval/goal_distance`` and its median, [S] float32.

        Args:
            loop: State of the loop, or of the learner alone.
            key: Typed key [] that determines the episodes; None for the same ones at every call.

        Raises:
            RequestError: ``key`` is an integer, an untyped key, or several keys.
        """
        if key is not None:
            _check_key("evaluate", key)
            if key.ndim:
                raise RequestError(f"evaluate takes one key for all seeds, not {key.shape} of them")
        return self.programs.evaluate(loop.train if isinstance(loop, LoopState) else loop, key)[0]

    def run(self, callbacks: Sequence[Callback] = ()) -> Iterator[Report]:
        """Train to the end and yield a `Report` per iteration, one iteration late.

        Compiles; evaluates every ``eval_interval`` iterations and at the end; writes metrics, checkpoints, the curve and the
        video into the run folder; and reports on stdout, where errors are ignored. Signals that would end the process are
        handled between iterations, in the main thread and unless the caller has handlers. After leaving the loop early, the
        next call continues from the last save.

        Args:
            callbacks: Each is called with every report that has an evaluation, once all of it is saved. One that returns True
                ends the run there, as if it were complete: the curve and the video are written, and resuming it only adds
                further iterations.

        Raises:
            RequestError: The folder, the saved run or the memory does not suit the configuration, or another process writes
                into the folder. Nothing was changed.
            NonFiniteError: A number is not finite. The state was dumped, not saved as a checkpoint.
            StorageError: A file could not be written. Earlier checkpoints are intact.
            Terminated: A signal other than Ctrl-C, after saving.
            KeyboardInterrupt: Ctrl-C, after saving.
        """
        loop = RunLoop(self.programs, self.folder, self._log, self._allow_resume, callbacks)
        return loop.reports(self._resume, self._overwrite)

    def _allow_resume(self) -> None:
        """Prepare the next call of `run`, which resumes; after a finished run, it reports that nothing is left to do."""
        self._resume, self._overwrite = True, False


def _check_key(function: str, key: Any) -> None:
    if not (hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise RequestError(f"{function} takes a typed JAX key, such as jax.random.key(0), not {key!r}")


def make_trainer(
    config: Config,
    run_dir: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    log: Sequence[str] | None = None,
    cache_programs: bool = False,
    policy_alone: bool = False,
) -> Trainer:
    """Build the environment and the programs of a configuration. Nothing is compiled, allocated or written.

    Args:
        config: Configuration of the run.
        run_dir: Folder of the files of `Trainer.run`; None for one below ``runs/``, named after the configuration.
        resume: Whether to continue the run in that folder; an empty one starts a new run, with a message.
        overwrite: Whether to delete the run in that folder and start again.
        log: Loggers in addition to metrics.jsonl: ``tensorboard``, ``wandb``. None: those of the resumed run.
        cache_programs: Whether to cache traced programs between processes. Only for processes that do not modify this package's
            modules, which the cache would not detect (`jaxrl_vis.run.compiled.trace_cache`).
        policy_alone: Whether the learner is only a policy, which cannot be trained (`Algorithm.of_policies`).

    Raises:
        RequestError: The configuration is invalid, differs from the saved run, or needs devices that are missing; the
            folder has other contents; or a logger is unknown or its library is missing.
    """
    if not isinstance(config, Config):
        raise RequestError(f"make_trainer takes a configuration, such as jaxrl_vis.preset('cpu'), not {config!r}")
    group.check(log or ())
    if run_dir is not None:
        RunFolder(Path(run_dir)).check(config, resume, overwrite)  # building an environment takes a while: refuse before
    with safe_streams():  # libraries that print, or warn, as they are imported and compile
        silence_cache_warnings()
        with shielded_children():  # threads that JAX starts with its first use of a device never see signals
            start_devices()
            if is_built_in(config.environment.env) and not custom_names(config):
                locate_env(config)  # imports MuJoCo, meanwhile
            check_devices()
        config = locate_env(config)
        program = make_train_step(make_env(config), config, policy_alone=policy_alone)
    return Trainer(config, program, run_dir, resume, overwrite, log, cache_programs)
