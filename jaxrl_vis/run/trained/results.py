"""Presentation of a run's results: the curve, and finally a video and a summary. Only the first process creates them."""

from collections.abc import Callable
from typing import Any

from jaxrl_vis.config import Config
from jaxrl_vis.report import videos
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.loggers.console import format_seconds
from jaxrl_vis.run.loggers.group import Loggers
from jaxrl_vis.run.storage.folder import RunFolder, learner_name
from jaxrl_vis.run.storage.progress import Progress


def describe(config: Config) -> str:
    """Summarise a configuration in a few words: algorithm, method, preset and seeds."""
    seeds = (
        f"seed {config.run.seed}"
        if config.run.seeds == 1
        else f"seeds {config.run.seed} to {config.run.seed + config.run.seeds - 1}"
    )
    return f"{learner_name(config)}, preset {config.run.preset}, {seeds}"


class Results:
    """Images that a run writes in addition to its metrics and checkpoints.

    Args:
        programs: Programs of the run.
        folder: Folder of the files.
        loggers: Loggers that also receive the images.
        echo: Called with each line of the summary.
    """

    def __init__(self, programs: Programs, folder: RunFolder, loggers: Loggers, echo: Callable[[str], None]):
        self._programs, self._folder, self._loggers, self._echo = programs, folder, loggers, echo

    def show(self, done: int, progress_now: Callable[[], Progress], recorded: dict[str, Any]) -> None:
        """Write the curve and video of a finished run, and print a summary.

        Args:
            done: Iterations completed.
            progress_now: Returns the current progress.
            recorded: Images of the last evaluation, see `evaluate.make_evaluate`; unused if observations are not images.
        """
        self.draw_curve(done)
        if self._programs.shows_images:
            videos.write_video(videos.first_seed(recorded), self._folder.video, self._programs.image_seconds)
            self._loggers.log_image("video", self._folder.video, self._env_steps(done))
        rows = [row for row in self._folder.rows() if row["iteration"] == done and row.get("eval/success") is not None]
        success = ", ".join(f"seed {row['seed']}: {row['eval/success']:.3f}" for row in rows)
        written = [file.name for file in (self._folder.curve, self._folder.video) if file.exists()]
        progress = progress_now()
        compiling = format_seconds(progress.compile_s)
        self._echo(f"success at the end: {success}; {format_seconds(progress.wall_s)}, of which {compiling} compiling")
        self._echo(f"see {', '.join([*written, self._folder.metrics.name])} in {self._folder.path}")

    def draw_curve(self, done: int) -> None:
        """Plot the learning curve up to iteration ``done`` into the run folder."""
        from jaxrl_vis.report import plots

        config, env = self._programs.config, self._programs.env
        plots.plot_run(
            self._folder.rows(),
            self._folder.curve,
            title=config.environment.env,
            subtitle=f"{describe(config)}, {config.run.eval_episodes} episodes per evaluation"
            + ("; thick: median, band: middle half" if config.run.seeds > 1 else ""),
            unit=env.distance_unit,
            threshold=env.threshold,
        )
        self._loggers.log_image("curve", self._folder.curve, self._env_steps(done))

    def _env_steps(self, done: int) -> int:
        return done * self._programs.program.steps_per_iteration
