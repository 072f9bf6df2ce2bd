"""Events of a run triggered by its evaluations: a new best checkpoint, and an early end."""

from collections.abc import Callable, Sequence

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import distributed
from jaxrl_vis.run.reports import Callback, Report
from jaxrl_vis.run.saving import Saver
from jaxrl_vis.run.storage import scores
from jaxrl_vis.run.storage.checkpoint import BEST, Checkpoints
from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.types import LoopState

SCORE, SCORED = "score", "scored"
"""Keys of the progress in a best checkpoint's manifest: its score, and the name of the metric."""


class Milestones:
    """Tracker of a run's best evaluation: saves the best checkpoint, and decides when the run may end early.

    The best score is stored only in the manifest of the best checkpoint, from which a resumed run reads it.

    Args:
        config: Configuration of the run; without ``best_by``, no best checkpoint is saved.
        checkpoints: Checkpoints of the run.
        saver: Writer of these checkpoints.
        echo: Called with one line about each unreadable manifest.
    """

    def __init__(self, config: Config, checkpoints: Checkpoints, saver: Saver, echo: Callable[[str], None]):
        self._config, self._checkpoints, self._saver, self._echo = config, checkpoints, saver, echo
        self._best: float | None = None

    def begin(self) -> None:
        """Read the best score so far from the best checkpoint, if there is one with the same metric."""
        if self._config.run.best_by is None:
            return
        for iteration in reversed(self._checkpoints.iterations(BEST)):
            try:
                progress = self._checkpoints.manifest(BEST, iteration)["progress"]
            except RequestError as error:
                self._echo(f"{error}: the next evaluation is the best")
                continue
            score = progress.get(SCORE)
            if progress.get(SCORED) == scores.metric_name(self._config) and isinstance(score, float):
                self._best = score
                return

    def save_if_best(self, loop: LoopState, iteration: int, values: PerSeed, progress: Progress) -> None:
        """Save the learner if its evaluation is the best so far; do nothing without ``best_by``.

        Args:
            loop: State of the loop after the evaluated iteration.
            iteration: Iterations completed.
            values: Metrics of the evaluation.
            progress: Progress of the host.
        """
        if self._config.run.best_by is None:
            return
        score = scores.score(self._config, values)
        if scores.is_better(self._config, score, self._best):
            about = {SCORE: score, SCORED: scores.metric_name(self._config)}
            self._saver.save_best(loop, iteration, progress, about)
            self._best = score

    def end_reason(self, report: Report, callbacks: Sequence[Callback]) -> str | None:
        """Call all ``callbacks`` with the report; return the reason to end the run after this evaluation, None to continue."""
        asked = False
        for callback in callbacks:  # each of them, also after one that asks to stop
            asked |= callback(report) is True
        score = scores.score(self._config, report.metrics)
        if distributed.any_process(scores.is_enough(self._config, score)):
            return f"{scores.metric_name(self._config)} {score:.3f} has reached --stop-at {self._config.run.stop_at:g}"
        return "a callback asked to stop" if distributed.any_process(asked) else None
