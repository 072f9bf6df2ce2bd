"""Notebooks run from top to bottom on the smallest settings, and are committed without outputs."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped(path: Path) -> None:
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert not cell.outputs
            assert cell.execution_count is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, tmp_path: Path, clean_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", clean_environment["PYTHONPATH"])
    monkeypatch.setenv("JAXRL_VIS_NOTEBOOK_FAST", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel shows figures in the notebook
    assert os.environ["JAX_PLATFORMS"] == "cpu"
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [(kind, data) for output in outputs for kind, data in output.get("data", {}).items()]
    figures = sum(kind == "image/png" for kind, _ in shown)
    text = "".join(output.get("text", "") for output in outputs)
    # The video of a whole run, as a page shows it wherever the notebook is read.
    assert sum(kind == "text/html" and "data:image/gif;base64," in data for kind, data in shown) == 1
    assert "of goals reached at the end" in text
    if path.stem == "01_quickstart":
        assert figures == 3  # start and goal; the curve; an episode of the policy
        assert "of 64 goals reached" in text
    else:
        assert figures == 2  # start and goals; the curve
        assert (tmp_path / "puck_push.py").exists()
        assert "eval/success" in text  # `eval` finds the task again by what the run folder says
