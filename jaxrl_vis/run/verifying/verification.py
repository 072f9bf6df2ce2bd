"""Verification of a run: repeats it from its seed and full checkpoints, and compares bit for bit. Nothing is written.

    report = verify_run("runs/mine")
    report.is_equal, report.rows, report.problems, report.unverified

Rows of metrics.jsonl are written at evaluations, so the repetition goes from evaluation to evaluation, and compares its state
with each checkpoint on the way. Everything except times and the run's id must be equal on the same platform with the same
versions and code; elsewhere, rounding may differ, and the report says by how much.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from jaxrl_vis.config import config_from_dict
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.run.compiled.memory import check_compiled, check_memory
from jaxrl_vis.run.storage.checkpoint import BEST, FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder, read_record, read_run_id
from jaxrl_vis.run.storage.lock import FILE_NAME as LOCK_NAME
from jaxrl_vis.run.storage.metrics import RUN_ID
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.run.storage.recent import Unusable
from jaxrl_vis.run.storage.sums import FILE_NAME as SUMS_NAME
from jaxrl_vis.run.storage.sums import compare_sums
from jaxrl_vis.run.trained.policy_file import check_whole
from jaxrl_vis.run.trained.results import describe
from jaxrl_vis.run.trainer import Trainer, make_trainer
from jaxrl_vis.run.trust import check as check_trusted
from jaxrl_vis.run.verifying.inspection import (
    LOST,
    RowConditions,
    check_files,
    check_record,
    format_list,
    missing_rows,
    read_file,
)
from jaxrl_vis.run.verifying.repetition import Repeater, Row, Verification, has_progress, saved_progress

__all__ = ["Verification", "verify", "verify_run"]

EVALUATIONS = 2
"""Default number of repeated evaluations: the second one shows that the first has no side effects."""


def verify_run(
    run_dir: Path | str,
    iterations: int | None = None,
    cache_programs: bool = False,
    echo: Callable[[str], None] = lambda line: None,
    trust: bool = False,
) -> Verification:
    """Repeat the beginning of a run and the continuation of each full checkpoint; its folder is not modified.

    Args:
        run_dir: The run folder; the run may still be in progress.
        iterations: Number of iterations to repeat from each start; None: up to the second evaluation.
        cache_programs: As in `jaxrl_vis.run.trainer.make_trainer`.
        echo: Called with a line about each step.
        trust: Whether to allow execution of the run's custom code (`jaxrl_vis.run.trust`).

    Raises:
        RequestError: There is no run, or it is not trusted, cannot be created any more, or needs more memory than is available.
    """
    path = Path(run_dir)
    check_whole(path, "verify")
    record = read_record(path)
    try:
        config = config_from_dict(record.get("config", {}))
    except RequestError as error:
        raise RequestError(f"the run in {path} cannot be verified: {error}") from error
    check_trusted(path, config, trust)
    findings = Verification()
    check_record(record, config, findings)
    devices = jax.local_device_count()
    if config.run.devices > devices:
        findings.caveats.append(f"the run was on {config.run.devices} devices, and is repeated on one")
        config = config.replace(devices=1, data_devices=None)
    trainer = make_trainer(config, cache_programs=cache_programs)
    return verify(trainer, path, record, iterations, findings, echo)


def verify(
    trainer: Trainer,
    path: Path,
    record: Mapping[str, Any],
    iterations: int | None,
    report: Verification,
    echo: Callable[[str], None],
) -> Verification:
    """Verify a run with an existing trainer of its configuration and the contents of its config.json.

    Findings are added to ``report``, which is returned; other arguments as for `verify_run`.
    """
    return _Verifier(trainer, RunFolder(path), record, report, echo).verify(iterations)


class _Verifier:
    def __init__(
        self, trainer: Trainer, folder: RunFolder, record: Mapping[str, Any], report: Verification, echo: Callable[[str], None]
    ):
        self._programs, self._config, self._folder = trainer.programs, trainer.config, folder
        self._record, self._report, self._echo = record, report, echo
        program = trainer.program
        self._expected = RowConditions(
            seeds=list(trainer.seeds),
            updates=program.updates_per_iteration,
            env_steps=program.steps_per_iteration,
            eval_interval=self._config.run.eval_interval,
            run_id=read_run_id(folder.path),
        )
        self._total: int = program.num_iterations
        self._checkpoints = Checkpoints(folder.checkpoints, self._echo, read_only=True)
        self._manifests: dict[tuple[str, int], dict[str, Any]] = {}
        self._rows: list[Row] = []

    def verify(self, iterations: int | None) -> Verification:
        """Run all checks, see `verify_run`."""
        try:
            self._print_origin()
            is_written = (self._folder.path / LOCK_NAME).exists()
            if is_written:
                self._report.notes.append("another process may be writing into the folder: verified as far as it is there")
            # Rows are on the disk before the checkpoint that follows: if they were read first, some of the checkpoint's could
            # be missing.
            self._read_manifests()
            self._read_recent()
            self._rows = read_file(self._folder.metrics, self._expected, is_written, self._report)
            repeater = self._repeat_all(iterations)
            due = {number for (_, number), manifest in self._manifests.items() if saved_progress(manifest).evaluation_due}
            reached = max((number - (number in due) for _, number in self._manifests), default=0)
            self._report.problems += missing_rows(
                self._rows, self._expected, reached, self._total, repeater.without_evaluation, is_written
            )
            is_finished = reached >= self._total and not is_written
            check_files(self._folder, is_finished, self._programs.shows_images, self._report)
            self._check_presence(is_written)
            return self._report
        finally:
            self._checkpoints.close()

    # -- Provenance

    def _print_origin(self) -> None:
        record, report = self._record, self._report
        device, versions = _mapping(record.get("device")), _mapping(record.get("versions"))
        name = provenance.device_name()
        current = {
            "revision": provenance.revision(),
            **provenance.versions(),
            **_flat(provenance.device_record() | {"name": name}),
        }
        recorded = {"revision": record.get("git_revision"), **versions, **_flat(device)}
        self._echo(
            f"{self._folder.path}: {self._config.environment.env}, {describe(self._config)}, run {self._expected.run_id}"
        )
        libraries = ", ".join(f"{name} {versions[name]}" for name in ("jax", "jaxlib", "python") if name in versions)
        where = f"{device.get('count')} {device.get('kind')}, {device.get('cpu_count')} cores"
        self._echo(f"made by revision {recorded['revision'] or 'unknown'}, {libraries or 'unknown versions'}, on {where}")
        changed = [name for name in recorded if recorded[name] != current.get(name)]
        report.caveats += [f"{name} {recorded[name]} then, {current.get(name)} now" for name in changed]
        if recorded["revision"] is None:
            report.caveats.append("config.json names no revision")
        elif str(recorded["revision"]).endswith("-dirty"):
            report.caveats.append("the revision had uncommitted changes")
        if current["platform"] != "cpu":
            report.caveats.append("equal numbers are guaranteed only on a CPU")

    # -- Checkpoints

    def _names(self) -> list[tuple[str, int]]:
        return sorted(
            ((tier, number) for tier in (LIGHT, FULL, BEST) for number in self._checkpoints.iterations(tier)),
            key=lambda name: name[::-1],
        )

    def _is_there(self, tier: str, number: int) -> bool:
        """Return True if a checkpoint still exists: a run in progress deletes old ones."""
        return (self._folder.checkpoints / tier / str(number)).is_dir()

    def _read_manifests(self) -> None:
        """Read and check all checkpoints, except the arrays of full ones, which are checked when they are restored."""
        problems = self._report.problems
        for tier, number in self._names():
            name = f"checkpoint {tier}/{number}"
            try:
                differences = compare_sums(self._folder.checkpoints / tier / str(number))
                manifest = self._checkpoints.manifest(tier, number)
                if tier in (LIGHT, BEST) and manifest.get("iteration") == number:
                    self._checkpoints.restore(tier, manifest, self._programs.shapes)
            except (RequestError, OSError) as error:
                if self._is_there(tier, number):
                    problems.append(
                        str(error) if isinstance(error, RequestError) else f"{name} cannot be read ({error.strerror})"
                    )
                continue
            if differences:
                problems.append(f"{name}: {format_list(differences)}")
                continue
            if differences is None:
                self._report.notes.append(f"{name} has no {SUMS_NAME}: only its arrays are compared with their checksums")
            if self._check_manifest(f"{tier}/{number}", number, manifest):
                self._manifests[tier, number] = manifest

    def _read_recent(self) -> None:
        """Read and check recent states. They are not synced to the disk, so a power cut can leave a damaged one."""
        recent = self._checkpoints.recent
        for number in recent.iterations():
            name = f"{RECENT}/{number}"
            try:
                manifest = recent.manifest(number)
                recent.restore(number, self._programs.shapes)
            except (Unusable, RequestError) as error:
                if number in recent.iterations():  # the run itself replaces them continually
                    self._report.notes.append(f"checkpoint {name} cannot be used ({error}), as after a power cut")
                continue
            if self._check_manifest(name, number, manifest):
                self._manifests[RECENT, number] = manifest

    def _check_manifest(self, name: str, number: int, manifest: Mapping[str, Any]) -> bool:
        """Return True if a manifest belongs to this run and its checkpoint's iteration; reports errors."""
        problems = self._report.problems
        if manifest.get("iteration") != number:
            problems.append(f"checkpoint {name} says that it is of iteration {manifest.get('iteration')}")
        elif manifest.get(RUN_ID) != self._expected.run_id:
            problems.append(f"checkpoint {name} is another run's ({manifest.get(RUN_ID, 'it names none')})")
        elif not has_progress(manifest, len(self._expected.seeds)):
            problems.append(f"checkpoint {name} is damaged (its manifest does not say how far the run was)")
        else:
            return True
        return False

    def _check_presence(self, is_written: bool) -> None:
        """Report a lack of checkpoints if the run is far enough to have one, unless another process is writing."""
        last = max((row["iteration"] for row in self._rows), default=0)
        interval = self._config.run.checkpoint_interval
        # An evaluation's rows are written before the checkpoint of the same iteration.
        wanted = last >= self._total or (interval > 0 and last > interval)
        if wanted and not is_written and not self._names() and not self._checkpoints.recent.iterations():
            self._report.problems.append(f"checkpoints are missing: the run has come to iteration {last}")

    # -- Repeating

    def _repeat_all(self, iterations: int | None) -> Repeater:
        """Repeat the run from the seed and from each full checkpoint; return the repeater."""
        programs, seed = self._programs, Progress()
        repeater = Repeater(programs, self._expected, self._rows, self._manifests, self._report, self._echo)
        compared_iterations = self._plan(0, seed, iterations)
        starts = [number for tier, number in self._manifests if tier == FULL]
        if compared_iterations or starts:
            self._compile()
        if compared_iterations:
            repeater.repeat("the seed", 0, seed, programs.init(programs.run_keys), compared_iterations)
        for number in starts:
            self._repeat_after(number, repeater, iterations)
        self._note_unverified(repeater.repeated)
        return repeater

    def _repeat_after(self, number: int, repeater: Repeater, iterations: int | None) -> None:
        """Repeat the run from a full checkpoint; a damaged one is reported."""
        manifest = self._manifests[FULL, number]
        try:
            restored = self._checkpoints.restore(FULL, manifest, self._programs.shapes)
        except RequestError as error:
            if self._is_there(FULL, number):
                self._report.problems.append(str(error))
                del self._manifests[FULL, number]
            return
        assert restored.loop is not None
        progress = saved_progress(manifest)
        compared_iterations = self._plan(number, progress, iterations)
        if compared_iterations:
            repeater.repeat(f"checkpoint full/{number}", number, progress, restored.loop, compared_iterations)
        else:
            self._report.unverified.append(f"checkpoint full/{number} is intact, but there is no row after it yet")

    def _compile(self) -> None:
        program, layout = self._programs.program, self._programs.layout
        check_memory(
            self._config,
            self._programs.shapes,
            program.replay_bytes,
            program.steps_per_iteration,
            layout,
            program.replay.frame_stack,
        )
        self._echo("compiling ...")
        check_compiled(self._programs.compile(), is_allocated=False, layout=layout)

    def _plan(self, first_iteration: int, progress: Progress, iterations: int | None) -> list[int]:
        """List iterations whose rows can be repeated from a state after ``first_iteration`` iterations."""
        mark, first = progress.replay_lost_at, first_iteration if progress.evaluation_due else first_iteration + 1
        # Up to the next loss of the replay: what follows it started from a state that was not saved.
        losses = [row[LOST] for row in self._rows if LOST in row and row[LOST] != mark and row[LOST] >= first_iteration]
        last = min(losses, default=math.inf)
        compared_iterations = sorted({row["iteration"] for row in self._rows if first <= row["iteration"] <= last})
        if iterations is None:
            return compared_iterations[:EVALUATIONS]
        near = [number for number in compared_iterations if number <= first_iteration + iterations]
        return near or compared_iterations[:1]

    def _note_unverified(self, repeated: set[int]) -> None:
        """Report rows and checkpoints that no repetition has reached."""
        unverified = self._report.unverified
        rest = [row["iteration"] for row in self._rows if row["iteration"] not in repeated]
        if rest:
            unverified.append(
                f"rows of {len(set(rest))} evaluations, of iterations {min(rest)} to {max(rest)}: checked, but not repeated"
            )
        lost = min((row[LOST] for row in self._rows if LOST in row), default=None)
        if lost is not None:
            unverified.append(
                f"after iteration {lost} the run resumed from a light checkpoint, without its replay: rows after it follow "
                "from full checkpoints only, not from the seed"
            )
        compared = self._report.checkpoints
        others = [name for tier, number in self._manifests if (name := f"{tier}/{number}") not in compared]
        if others:
            unverified.append(f"checkpoints {format_list(others)}: intact, but not reached by a repetition")


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _flat(device: Mapping[str, Any]) -> dict[str, Any]:
    return {name: device[name] for name in ("platform", "kind", "cpu_count", "name") if name in device}
