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
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    text = "".join(output.get("text", "") for output in outputs)
    assert kinds.count("image/gif") == 1  # the video of a whole run
    assert "of goals reached at the end" in text
    if path.stem == "01_quickstart":
        assert kinds.count("image/png") == 3  # start and goal; the curve; an episode of the policy
        assert "of 64 goals reached" in text
    else:
        assert kinds.count("image/png") == 2  # start and goals; the curve
        assert (tmp_path / "puck_push.py").exists()
        assert "eval/success" in text  # `eval` finds the task again by what the run folder says
