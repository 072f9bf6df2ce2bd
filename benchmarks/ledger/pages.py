"""Pages with tables written from records: one writer per table and its markers."""

from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks import target_decay
from benchmarks.claims import pages as claims
from benchmarks.ledger import ablations
from benchmarks.ledger.markers import fill
from benchmarks.ledger.records import CHECKOUT, RESULTS
from benchmarks.ledger.tables import (
    audit,
    comparison,
    contrastive,
    exported,
    factors,
    host,
    lab_results,
    pixels,
    platforms,
    push,
    render,
    scaling,
    stalks,
    weighting,
)
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically

Writer = Callable[[Path], str | None]
"""Function from the folder of records to a table in Markdown, or to None to leave the page's table unchanged."""


def renderer_parity(results: Path) -> str:
    """Return the table of docs/lab/renderer_parity.md as Markdown."""
    from benchmarks import render_parity  # imports the models of the tests

    return render_parity.table(render_parity.read_rows(results / render_parity.TARGET.name))


def soak(results: Path) -> str | None:
    """Return the table of docs/reliability.md, summed over the records in ``soak``, as Markdown; None if there are none."""
    from benchmarks.soak.record import Record, add_records

    files = sorted((results / "soak").glob("*.json"))
    return add_records([Record.read(file) for file in files]).table() if files else None


PAGES: dict[str, dict[str, Writer]] = {
    "README.md": {"comparison": comparison.comparison_table},
    "docs/index.md": {"comparison": comparison.comparison_table},
    "docs/lab/results.md": {"results table": lab_results.results_table, "speed table": lab_results.speed_table},
    "docs/scaling.md": {"devices": scaling.devices_table, "processes": scaling.processes_table},
    "docs/lab/real_stalks.md": {"factors": factors.factors_table},
    "docs/lab/meshes.md": {"meshes": render.gpu_mesh_table, "meshes on a CPU": render.cpu_mesh_table},
    "docs/lab/renderer_speed.md": {"warp": render.warp_table, "mujoco": render.mujoco_table},
    "docs/reliability.md": {"soak": soak},
    "docs/lab/renderer_parity.md": {"table": renderer_parity},
    "docs/phenotyping.md": {
        "lenses": stalks.lens_table,
        "families": stalks.families_table,
        "fresh": stalks.fresh_table,
        "thesis": stalks.thesis_table,
        "shifts": stalks.shifts_table,
    },
    "docs/export.md": {"policies": exported.exported_table},
    "docs/algorithms.md": {"forms": contrastive.forms_table},
    "docs/indicator_rewards.md": {"host": host.host_table, "audit": audit.audit_table},
    "docs/pixels.md": {"tasks": pixels.tasks_table, "training": pixels.training_table},
    "docs/tasks.md": {"push on a GPU": push.gpu_table, "push on a CPU": push.cpu_table, "push from images": push.images_table},
    "docs/where_it_ran.md": {"platforms": platforms.platforms_table, "not run": platforms.not_run_table},
    "docs/weighting.md": {
        "digits": weighting.digits_table,
        "torchjd": weighting.torchjd_table,
        "cost": weighting.cost_table,
    },
    "docs/lab/ablations.md": {"curves": ablations.index_table},
    "docs/lab/target_decay.md": {"tables": target_decay.tables},
}
"""Writers of each page's tables by the name in their markers, except the learning studies' (`benchmarks.claims.pages`)."""


def writers(results: Path) -> dict[str, dict[str, Writer]]:
    """Return the writers of `PAGES`, and those of the learning studies if ``results`` is this checkout's."""
    merged = {page: dict(of_page) for page, of_page in PAGES.items()}
    for page, texts in claims.tables().items() if results.resolve() == RESULTS else ():
        merged.setdefault(page, {}).update({name: lambda _, text=text: text for name, text in texts.items()})
    return merged


def fill_page(text: str, of_page: dict[str, Writer], results: Path = RESULTS) -> str:
    """Return the text of a page with its tables written from the records.

    Raises:
        RequestError: A marker is missing, evidence contradicts its row, or records cannot be read.
    """
    for name, write in of_page.items():
        table = write(results)
        if table is not None:
            text = fill(text, name, table)
    return text


def write_pages(results: Path = RESULTS, checkout: Path = CHECKOUT) -> Iterator[tuple[Path, bool]]:
    """Write the tables of every page; yield the page's path, and True if it changed.

    Raises:
        RequestError: As in `fill_page`; or a page is missing.
    """
    for name, of_page in writers(results).items():
        page = checkout / name
        if not page.exists():
            raise RequestError(f"there is no {page}: tables are written in a checkout")
        before = page.read_text(encoding="utf-8")
        after = fill_page(before, of_page, results)
        if after != before:
            write_atomically(page, after)
        yield page, after != before


def outdated_page_messages(results: Path = RESULTS, checkout: Path = CHECKOUT) -> Iterator[str]:
    """Yield a complaint for every page whose tables differ from the records or cannot be written; missing pages are skipped.

    Raises:
        RequestError: A record of the learning studies cannot be read.
    """
    for name, of_page in writers(results).items():
        page = checkout / name
        if not page.exists():
            continue
        text = page.read_text(encoding="utf-8")
        try:
            if fill_page(text, of_page, results) != text:
                yield f"{name}: its tables differ from the records: make tables"
        except RequestError as error:
            yield f"{name}: {error}"
