"""Tests of the notebooks: they run from top to bottom with the smallest settings, and are committed without outputs."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

SLOW = ("07_weighting",)
NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))

# Figures, and videos of a whole run as a page shows them wherever the notebook is read.
SHOWN = {
    "01_quickstart": (3, 1),  # start and goal; the curve; an episode of the policy
    "02_new_environment": (2, 1),  # start and goals; the curve
    "03_indicator_rewards": (3, 0),  # which frames count as equal; curves; diagnostics
    "04_auxiliary_losses": (1, 0),  # errors and weights
    "05_phenotyping": (3, 0),  # a pair; its overlay; widths against the truth
    "06_grasping": (2, 0),  # a pair and its mask; stalks and grasp points from above
    "07_weighting": (3, 0),  # pairs of digits; accuracies on two tasks, and on five
}
SAID = {
    "05_phenotyping": ("overlays (plots: 1, pairs skipped: 0)", "synthetic: 8 stalks were counted, 8 are there"),
    "01_quickstart": ("of goals reached at the end", "of 64 goals reached"),
    "02_new_environment": ("of goals reached at the end", "eval/success"),  # `eval` finds the task by what the run folder says
    "03_indicator_rewards": ("oracle  ", "indicator_balance_filter", "of goals reached"),
    "04_auxiliary_losses": ("OL-AUX-5           error on unseen inputs",),
    "07_weighting": ("sum           lower 0.", "upgrad        digit 0."),
    "06_grasping": ("3 pairs of 256 x 256 pixels", "default                      stitches off by", "of the thesis"),
}


# Imported by the tests, because every worker collects this file: `nbformat` parses a grammar for a second.
@pytest.fixture(scope="module")
def nbformat() -> Any:
    return pytest.importorskip("nbformat")


@pytest.fixture(scope="module")
def nbclient() -> Any:
    return pytest.importorskip("nbclient")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped(path: Path, nbformat: Any) -> None:
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert not cell.outputs
            assert cell.execution_count is None


# Runs of equal configurations, of any of the notebooks, share what is traced and compiled.
_ALIKE = f"""
import sys
sys.path.append({str(Path(__file__).resolve().parents[1])!r})
import quick_jax
import small_program
from jaxrl_vis.run import trainer
trainer.make_train_step = small_program.make_train_step
"""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory, nbclient: Any) -> Iterator[Any]:
    """Kernel shared by all notebooks, so that modules are imported once; each begins without the names of earlier ones."""
    jupyter_client = pytest.importorskip("jupyter_client")
    checkout, ipython = Path(__file__).resolve().parents[2], tmp_path_factory.mktemp("ipython")
    startup = ipython / "profile_default/startup"
    startup.mkdir(parents=True)
    (startup / "programs.py").write_text(_ALIKE)
    changes = {
        "PYTHONPATH": os.pathsep.join((str(checkout), str(checkout / "envs"))),
        "JAXRL_VIS_NOTEBOOK_FAST": "1",
        "IPYTHONDIR": str(ipython),
    }
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}  # figures go into the notebook
    assert environment["JAX_PLATFORMS"] == "cpu"
    manager = jupyter_client.AsyncKernelManager(kernel_name="python3")
    nbclient.util.run_sync(manager.start_kernel)(env=environment | changes)
    yield manager
    nbclient.util.run_sync(manager.shutdown_kernel)(now=True)


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.slow if path.stem in SLOW else ()) for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_notebook_runs(path: Path, tmp_path: Path, kernel: Any, nbformat: Any, nbclient: Any) -> None:
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {tmp_path}"))
    nbclient.NotebookClient(notebook, timeout=600, km=kernel).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [(kind, data) for output in outputs for kind, data in output.get("data", {}).items()]
    figures = sum(kind == "image/png" for kind, _ in shown)
    text = "".join(output.get("text", "") for output in outputs)
    videos = sum(kind == "text/html" and "data:image/gif;base64," in data for kind, data in shown)
    assert (figures, videos) == SHOWN[path.stem]
    for said in SAID[path.stem]:
        assert said in text
    if path.stem == "02_new_environment":
        assert (tmp_path / "puck_push.py").exists()
