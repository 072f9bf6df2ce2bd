"""Command ``jaxrl-vis export``: export the policy of a run for use without this project."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from jaxrl_vis.cli.checks import check_run, may_run_code, read_checkpoint
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import CheckpointOption, TrustOption
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import check_path

if TYPE_CHECKING:
    from jaxrl_vis.run.exported.export import Check


@dataclasses.dataclass(frozen=True)
class Export(TrustOption, CheckpointOption):
    """Export a trained policy to a file that runs without this project, with its contract and golden frames; or check one.

    The exit status is 1 if the file's actions differ from our own by more than 1e-4.
    """

    run_dir: Annotated[Path | None, AlsoPositional()] = None
    """The run folder, or the name of a policy that comes with the package, such as fetch; not with --check."""
    format: Literal["onnx", "stablehlo", "safetensors"] = "onnx"
    """Format: ONNX (needs the extra ``export``), StableHLO for JAX without this project, or weights by name."""
    out: Path | None = None
    """Folder for the policy, contract.json and golden.npz; export/FORMAT in the run folder if not given (for a policy of the
    package, in NAME/ in the current folder)."""
    seed: int | None = None
    """Seed, for a run with several; the first if not given."""
    overwrite: bool = False
    """Replace an exported policy in the folder."""
    check: Path | None = None
    """Export nothing: run this exported file on its golden frames, and print the maximum difference. --format, --seed and
    --checkpoint are then unused."""


def run(options: Export) -> int:
    """Export a policy, or check an exported one."""
    if options.check is not None:
        if options.run_dir is not None or options.out is not None or options.overwrite:
            raise RequestError("--check takes an exported file and writes nothing: leave out the run, --out and --overwrite")
        check_path(options.check)
        from jaxrl_vis.run.exported.export import check_file

        return _report(check_file(options.check))
    if options.run_dir is None:
        raise RequestError("no run given: name its folder, or an exported file with --check")
    run_dir = check_run(options.run_dir)
    if options.out is not None:
        check_path(options.out)
    checkpoint = read_checkpoint(options.checkpoint)
    trust = may_run_code(run_dir, options.trust)
    from jaxrl_vis.run.exported.export import export_run

    return _report(
        export_run(
            run_dir,
            options.format,
            options.out,
            seed=options.seed,
            checkpoint=checkpoint,
            overwrite=options.overwrite,
            trust=trust,
        )
    )


def _report(check: "Check") -> int:
    verdict = "" if check.passed else ", which is too much: export it again"
    print(f"{check.file}: largest difference {check.difference:.1e} over {check.count} golden frames{verdict}")
    return 0 if check.passed else 1
