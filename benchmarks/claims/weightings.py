"""Tables of figure ``weightings`` in docs/weighting.md: all weightings of five auxiliary losses, on three tasks."""

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import Record, variants
from jaxrl_vis.studies.weightings import FAMILY, STUDIES

GUIDE = "docs/weighting.md"
BUDGETS = STUDIES["weightings"].steps
_BASELINE = "sum"


def task_table(task: str, records: dict[str, Record]) -> str:
    """Return the table of a task, by descending mean success."""
    budget, base = BUDGETS[task], records[_BASELINE]
    order = sorted(records, key=lambda variant: -records[variant].means(budget).mean())
    columns = [
        c.seeds(),
        c.mean_success(budget),
        c.p_value_against(base, f"`{_BASELINE}`", budget),
        c.success_at(base.end),
        c.seconds(),
    ]
    return table([task], [Row(f"`{variant}`", records[variant]) for variant in order], columns)


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text; none without records."""
    by_task = {task: variants(FAMILY, task) for task in BUDGETS}
    texts = {task: task_table(task, records) for task, records in by_task.items() if _BASELINE in records}
    return {GUIDE: texts} if texts else {}
