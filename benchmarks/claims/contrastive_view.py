"""Table of docs/tasks.md: methods on the task of contrastive RL, from the runs in ``results/contrastive_view``."""

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import runs
from jaxrl_vis.report.plots import format_steps

GUIDE, FOLDER = "docs/tasks.md", "contrastive_view"
_METHODS = {
    "indicator_balance_filter": "`indicator_balance_filter`",
    "oracle": "`oracle`",
    "contrastive": "`contrastive`, `stable`",
    "contrastive_nce": "`contrastive`, `nce`",
    "contrastive_1M": "`contrastive`, `stable`",
    "contrastive_cpu": "`contrastive`, `stable`; preset `cpu`",
    "contrastive_nce_cpu": "`contrastive`, `nce`; preset `cpu`",
    "own_contrastive_rgb": "`contrastive`, `stable`; own view",
    "own_contrastive": "`contrastive`, `stable`; own view, RGB-D",
    "own_contrastive_nce": "`contrastive`, `nce`; own view, RGB-D",
    "own_contrastive_cpu_1M": "`contrastive`, `stable`; own view, RGB-D, preset `cpu`",
}
"""Method by name of the run, in the order of the rows."""
_EARLY = 15_000


def tables() -> dict[str, dict[str, str]]:
    """Return the table, page -> marker -> text; none without records."""
    records = runs(FOLDER)
    if not records:
        return {}
    columns = [
        c.seeds(),
        c.Column("environment steps", lambda record: format_steps(record.end)),
        c.steps_to(0.97),
        c.steps_to(0.9),
        c.success_at(_EARLY),
        c.final(),
        c.seconds(),
        c.names(),
    ]
    rows = [Row(_METHODS[name], records[name]) for name in sorted(records, key=list(_METHODS).index)]
    return {GUIDE: {FOLDER: table(["method"], rows, columns)}}
