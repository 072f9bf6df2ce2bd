"""Tables of figure ``goals`` in docs/algorithms.md: methods that learn from goal images, a table per task."""

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import Record, variants
from jaxrl_vis.studies.goals import FAMILY, STUDIES

GUIDE = "docs/algorithms.md"
BUDGETS = {**STUDIES["goals"].steps, **STUDIES["goals"].optional_steps}
_BASELINE = "oracle"
_LEVEL = 0.9


def task_table(task: str, records: dict[str, Record]) -> str:
    """Return the table of a task, in the order of its records."""
    budget, base = BUDGETS[task], records[_BASELINE]
    columns = [
        c.seeds(),
        c.steps_to(_LEVEL),
        c.mean_success(budget),
        c.p_value_against(base, f"`{_BASELINE}`", budget),
        c.success_at(base.end),
        c.seconds(),
    ]
    return table([task], [Row(f"`{variant}`", record) for variant, record in records.items()], columns)


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text; none without records."""
    by_task = {task: variants(FAMILY, task) for task in BUDGETS}
    texts = {task: task_table(task, records) for task, records in by_task.items() if _BASELINE in records}
    return {GUIDE: texts} if texts else {}
