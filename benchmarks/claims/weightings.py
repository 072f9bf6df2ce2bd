"""Tables of figure ``weightings`` in docs/weighting.md: all weightings of five auxiliary losses, on three tasks."""

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import Record, study
from jaxrl_vis.studies.weightings import FAMILY, STUDIES

GUIDE = "docs/weighting.md"
_BUDGETS = STUDIES["weightings"].steps
_BASELINE = "sum"


def _records(task: str) -> dict[str, Record]:
    """Return the stored runs on a task by weighting, with fresh seeds if there are any."""
    records = {}
    for variant in FAMILY.variants:
        try:
            records[variant] = study(FAMILY.name, f"{task}-{variant}-fast", is_fresh=True)
        except LookupError:
            continue
    return records


def task_table(task: str, records: dict[str, Record]) -> str:
    """Return the table of a task, by descending mean success."""
    budget, base = _BUDGETS[task], records[_BASELINE]
    order = sorted(records, key=lambda variant: -records[variant].means(budget).mean())
    columns = [
        c.seeds(),
        c.mean_success(budget),
        c.p_value_against(base, f"`{_BASELINE}`", budget),
        c.success_at(base.end),
        c.Column("seconds in all", lambda record: f"{record.rows[-1]['time/wall_s'] - record.rows[-1]['time/compile_s']:.0f}"),
    ]
    return table([task], [Row(f"`{variant}`", records[variant]) for variant in order], columns)


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text; none without records."""
    by_task = {task: _records(task) for task in _BUDGETS}
    texts = {task: task_table(task, records) for task, records in by_task.items() if _BASELINE in records}
    return {GUIDE: texts} if texts else {}
