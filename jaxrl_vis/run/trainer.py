"""Training from Python.

    trainer = make_trainer(config)
    loop = trainer.init(jax.random.key(0))
    loop, metrics = trainer.train_iteration(loop)       # one compiled step; what you do between two of them is up to you
    for report in trainer.run(): ...                    # or the whole thing: logs, evaluates, saves, draws

and looking at what was trained: `evaluate_run`, `play_run`.
"""

import concurrent.futures
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from jaxrl_vis.config import Config
from jaxrl_vis.errors import NonFiniteError, RequestError, Terminated
from jaxrl_vis.report import videos, viewer
from jaxrl_vis.run.checkpoint import Checkpoints, Restored
from jaxrl_vis.run.folder import RunFolder, default_folder, read_config
from jaxrl_vis.run.loop import Report, RunLoop
from jaxrl_vis.types import LoopState, Metrics, TrainState

__all__ = [
    "NonFiniteError",
    "Report",
    "Terminated",
    "Trainer",
    "enable_compilation_cache",
    "evaluate_run",
    "make_trainer",
    "play_run",
]

# Evaluation draws from a key of its own, the same at every evaluation and for every seed.
_EVALUATION_SEED = 2**31 - 1


def enable_compilation_cache() -> str:
    """Keeps compiled programs in a folder, so that the second start takes seconds.

    A folder that was chosen already (JAX_COMPILATION_CACHE_DIR, or jax.config) is left as it is; otherwise it is
    ``jaxrl-vis/xla`` in the user's cache folder.

    Returns:
        The folder.
    """
    if not jax.config.jax_compilation_cache_dir:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(caches / "jaxrl-vis" / "xla"))
        # JAX decides at its first compilation whether it has a cache, and a notebook has compiled something by now.
        compilation_cache.reset_cache()
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    return str(jax.config.jax_compilation_cache_dir)


class Trainer:
    """A configuration, the program it stands for, and the run folder. Nothing is compiled, allocated or written yet.

    Args:
        config: The run.
        program: What `jaxrl_vis.learner.train_step.make_train_step` returns, or anything with the same attributes.
        run_dir: Where `run` puts its files; None: `run_folder.default_folder`.
        resume: Go on with the run in ``run_dir``.
        overwrite: Delete the run in ``run_dir`` and start again.

    Attributes:
        config: The run.
        env: The world.
        program: The compiled functions and their sizes.
        folder: The run folder.
        seeds: The seeds, in the order of the seed axis.
    """

    def __init__(
        self,
        config: Config,
        program: Any,
        run_dir: Path | str | None = None,
        resume: bool = False,
        overwrite: bool = False,
    ):
        self.config, self.program = config, program
        self.env = getattr(program, "env", None)
        self.folder = RunFolder(default_folder(config) if run_dir is None else Path(run_dir))
        self.seeds = range(config.seed, config.seed + config.seeds)
        self.distance_unit: str = getattr(self.env, "distance_unit", "m")
        self.threshold: float | None = getattr(self.env, "threshold", None)
        self._resume, self._overwrite = resume, overwrite
        self._compiled: dict[str, Any] = {}
        if run_dir is not None:
            self.folder.check(config, resume, overwrite)

    @property
    def run_keys(self) -> jax.Array:
        """[S] typed keys: seed i of `run` starts from ``jax.random.key(config.seed + i)``."""
        return jnp.stack([jax.random.key(seed) for seed in self.seeds])

    @functools.cached_property
    def shapes(self) -> LoopState:
        """Shapes and types of the loop state; traced, not allocated."""
        return jax.eval_shape(self.program.init, self.run_keys)

    @functools.cached_property
    def shows_images(self) -> bool:
        """Whether what the robot sees can be shown in a video."""
        seeds, episodes, slots, *image = self.shapes.replay.episodes.frames.shape
        if len(image) == 3:  # of stacked images the newest is shown
            image[0] //= getattr(self.env, "frame_stack", 1)
        return videos.shows_images((episodes, slots, *image))

    @property
    def frame_seconds(self) -> float:
        """How long a frame of the video is shown, s: as long as it lasted, but not too fast to follow."""
        return max(0.04, float(getattr(self.env, "control_period", 0.04)))

    def compile(self) -> dict[str, Any]:
        """Compiles everything that a run needs, side by side; `run` does it by itself.

        Each function is traced once, here, and what was compiled here is what runs later.

        Returns:
            The compiled programs by name.
        """
        enable_compilation_cache()
        names = ["init", "train_iteration", "evaluate"]
        # Tracing is Python and goes one by one; XLA compiles without the interpreter's lock.
        lowered = {name: self._lower(name) for name in names if name not in self._compiled}
        with concurrent.futures.ThreadPoolExecutor() as pool:
            futures = {name: pool.submit(program.compile) for name, program in lowered.items()}
            self._compiled |= {name: future.result() for name, future in futures.items()}
        return dict(self._compiled)

    def _lower(self, name: str) -> Any:
        arguments: dict[str, tuple] = {
            "init": (self.run_keys,),
            "train_iteration": (self.shapes,),
            "evaluate": (self.shapes.train, jax.random.key(0)),
        }
        return getattr(self.program, name).lower(*arguments[name])

    def _call(self, name: str, *arguments: Any) -> Any:
        if name not in self._compiled:
            enable_compilation_cache()
            self._compiled[name] = self._lower(name).compile()
        return self._compiled[name](*arguments)

    def init(self, key: jax.Array) -> LoopState:
        """A fresh learner with an empty replay.

        Args:
            key: A typed key. With one seed it is that seed's key, so ``init(jax.random.key(0))`` is what `run` starts from with
                ``seed=0``; with several it is split into one each. Or [S] keys, taken as they are.
        """
        if key.ndim == 0:
            key = key[None] if self.config.seeds == 1 else jax.random.split(key, self.config.seeds)
        return self._call("init", key)

    def train_iteration(self, loop: LoopState) -> tuple[LoopState, Metrics]:
        """One iteration: a rollout, then gradient steps. ``loop`` is donated: use what is returned.

        Returns:
            The new state, and metrics of [S] float32 that the device may still be working on.
        """
        return self._call("train_iteration", loop)

    def evaluate(self, loop: LoopState | TrainState, key: jax.Array | None = None) -> Metrics:
        """``eval/success``, ``eval/goal_distance`` and its median, [S] float32, of the policy without noise.

        Args:
            loop: What was trained.
            key: Draws the episodes; None: always the same ones.
        """
        return self.watch(loop, key)[0]

    def watch(self, loop: LoopState | TrainState, key: jax.Array | None = None) -> tuple[Metrics, dict[str, jax.Array]]:
        """As `evaluate`, and with it the images of the first few episodes of every seed: for `videos.first_seed`."""
        key = jax.random.key(_EVALUATION_SEED) if key is None else key
        return self._call("evaluate", loop.train if isinstance(loop, LoopState) else loop, key)

    def run(self) -> Iterator[Report]:
        """Trains to the end and yields a `Report` per iteration, one iteration late.

        Compiles; evaluates every ``eval_interval`` iterations and at the end; writes metrics, checkpoints, the curve and the
        video into the run folder; and says on stdout what it does. SIGTERM and Ctrl-C (in the main thread) are acted upon
        between two iterations.

        Raises:
            RequestError: The folder, the saved run or the memory does not suit the configuration. Nothing was allocated.
            NonFiniteError: A number is not finite any more. The state was dumped, and was not saved as a checkpoint.
            Terminated: SIGTERM, after saving.
            KeyboardInterrupt: Ctrl-C, after saving.
        """
        yield from RunLoop(self, self.folder).reports(self._resume, self._overwrite)
        # Asked again, a finished run is resumed, and says that there is nothing left to do.
        self._resume, self._overwrite = True, False


def make_trainer(config: Config, run_dir: Path | str | None = None, resume: bool = False, overwrite: bool = False) -> Trainer:
    """Builds the world and the program of a configuration. Compiles, allocates and writes nothing.

    Args:
        config: The run.
        run_dir: Where `Trainer.run` puts its files; None: below ``runs/``, named after the configuration.
        resume: Go on with the run in that folder; a folder without a run starts at the beginning, and says so.
        overwrite: Delete the run in that folder and start again.

    Raises:
        RequestError: The configuration asks for something that cannot be, or contradicts the saved run.
    """
    from jaxrl_vis.learner.train_step import (  # here: a trainer with a program of its own needs no world
        make_env,
        make_train_step,
    )

    if run_dir is not None:
        RunFolder(Path(run_dir)).check(config, resume, overwrite)  # building a world takes a while: refuse before
    return Trainer(config, make_train_step(make_env(config), config), run_dir, resume, overwrite)


def _load(trainer: Trainer) -> Restored:
    """The newest good learner of a run.

    Raises:
        RequestError: There is none.
    """
    checkpoints = Checkpoints(trainer.folder.checkpoints, read_only=True)
    try:
        restored = checkpoints.restore_train(trainer.shapes)
    finally:
        checkpoints.close()
    if restored is None:
        raise RequestError(f"the run in {trainer.folder.path} has no usable checkpoint: train it first")
    return restored


def _open_run(run_dir: Path | str, **changes: Any) -> Trainer:
    config = read_config(Path(run_dir)).replace(**changes)
    trainer = make_trainer(config)
    trainer.folder = RunFolder(Path(run_dir))
    return trainer


def evaluate_run(run_dir: Path | str, episodes: int | None = None) -> dict[str, list[float]]:
    """Evaluates the newest good checkpoint of a run.

    Args:
        run_dir: The run folder.
        episodes: How many; None: as many as during training.

    Returns:
        ``eval/success``, ``eval/goal_distance`` and the like: one number per seed.

    Raises:
        RequestError: There is no run, or nothing usable in it.
    """
    trainer = _open_run(run_dir, **({} if episodes is None else {"eval_episodes": episodes}))
    restored = _load(trainer)
    values = jax.device_get(trainer.evaluate(restored.train))
    return {name: [float(number) for number in value] for name, value in values.items()}


def play_run(run_dir: Path | str, out: Path | str, episodes: int = 6, three_dimensional: bool = False) -> None:
    """Plays episodes with the first seed of the newest good checkpoint of a run, and writes them as a video.

    Args:
        run_dir: The run folder.
        out: .gif, .mp4 (needs imageio-ffmpeg), .html or .png.
        episodes: How many to show.
        three_dimensional: Write an .html page for brax's viewer (needs brax) instead of the robot's images; for state tasks,
            too.

    Raises:
        RequestError: There is no run, nothing usable in it, no image to show, or no way to write ``out``.
    """
    out = Path(out)
    (viewer.check_page if three_dimensional else videos.check_output)(out)
    trainer = _open_run(run_dir, eval_episodes=max(1, episodes))
    if not (trainer.shows_images or three_dimensional):
        raise RequestError(f"{trainer.config.env} shows the robot no images: play a run on a Visual task, or with --html")
    restored = _load(trainer)
    key, parts, count = jax.random.key(_EVALUATION_SEED), [], 0
    if three_dimensional:
        viewer.write_page(trainer.program, restored.train, key, max(1, episodes), out)
        return
    while count < episodes:
        _, images = trainer.watch(restored.train, jax.random.fold_in(key, count) if parts else None)
        parts.append(videos.first_seed(images))
        count += len(parts[-1].success)
    joined = videos.EpisodeImages(
        *(np.concatenate([getattr(part, name) for part in parts])[:episodes] for name in ("frames", "goals", "success"))
    )
    videos.write_video(joined, out, trainer.frame_seconds, max_episodes=episodes)
