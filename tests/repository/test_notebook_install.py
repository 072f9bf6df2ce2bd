"""Tests of the notebooks' first cell: it installs the package if it is missing, or stops with one line if it cannot."""

import importlib.util
import json
import runpy
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
INSTALL = runpy.run_path(str(FOLDER / "install.py"))


def first_cell(path: Path) -> str:
    cells = json.loads(path.read_text(encoding="utf-8"))[
        "cells"
    ]  # `nbformat` parses a grammar for a second when it is imported
    return next("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


CELL = first_cell(FOLDER / "01_quickstart.ipynb")


@pytest.fixture
def without_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Current folder without a checkout beside it, in a Python that does not find the package."""
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "jaxrl_vis" else found(name))
    monkeypatch.delenv("JAXRL_VIS_REPOSITORY", raising=False)
    folder = tmp_path / "session"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def fake_checkout(folder: Path, problem: str | None = None) -> Path:
    """Create a checkout whose installer writes the file ``installed`` and returns ``problem``; return ``folder``."""
    (folder / "notebooks").mkdir(parents=True)
    (folder / "notebooks" / "install.py").write_text(
        f"def install(source):\n    open('installed', 'w').write(str(source))\n    return {problem!r}\n"
    )
    return folder


def stopped(cell: str) -> str:
    """Run the cell, and return the line with which it stops."""
    with pytest.raises(Exception) as caught:
        exec(cell, {})
    assert type(caught.value).__name__ == "Stop"
    (line,) = caught.value._render_traceback_()  # type: ignore[attr-defined]
    assert "\n" not in line
    return line


def with_address(address: Any) -> str:
    cell = CELL.replace('REPOSITORY = ""', f'REPOSITORY = "{address}"')
    assert cell != CELL
    return cell


def test_all_notebooks_have_the_same_first_cell():
    cells = {first_cell(path) for path in FOLDER.glob("*.ipynb")}
    assert len(cells) == 1
    assert '# @param {type: "string"}' in CELL  # the form field on Colab


def test_nothing_happens_where_the_package_is_installed(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "run", pytest.fail)
    exec(with_address("nowhere"), {})
    assert not list(tmp_path.iterdir())


def test_without_an_address_one_line_asks_for_it(without_package):
    assert "set REPOSITORY in this cell" in stopped(CELL)


def test_an_address_that_cannot_be_cloned_stops_with_what_git_says(without_package):
    line = stopped(with_address(without_package / "missing"))
    assert line.startswith("could not clone ") and "does not exist" in line


def test_the_checkout_of_the_notebook_is_installed(without_package):
    fake_checkout(without_package.parent)
    exec(CELL, {})
    assert Path("installed").read_text() == ".."


@pytest.mark.parametrize("variable", [False, True])
def test_the_address_may_be_a_folder(without_package, tmp_path, monkeypatch, variable):
    checkout = fake_checkout(tmp_path / "elsewhere")
    if variable:
        monkeypatch.setenv("JAXRL_VIS_REPOSITORY", str(checkout))
    exec(CELL if variable else with_address(checkout), {})
    assert Path("installed").read_text() == str(checkout)


def test_other_addresses_are_cloned_once(without_package, tmp_path):
    checkout = fake_checkout(tmp_path / "elsewhere")
    git = ["git", "-c", "user.name=Nobody", "-c", "user.email=nobody@example.org"]
    for words in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "--message", "all"]):
        subprocess.run([*git, *words], cwd=checkout, check=True)
    cell = with_address(f"file://{checkout}")
    for _ in range(2):
        exec(cell, {})
        assert Path("installed").read_text() == "jaxrl-vis"
    assert Path("jaxrl-vis/notebooks/install.py").exists()


def test_a_failing_installation_stops_with_its_own_line(without_package, tmp_path):
    assert stopped(with_address(fake_checkout(tmp_path / "elsewhere", "it cannot be"))) == "it cannot be"


def test_a_notebook_shows_one_line_and_goes_no_further(tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.delenv("JAXRL_VIS_REPOSITORY", raising=False)
    hide = "import importlib.util\nimportlib.util.find_spec = lambda name: None"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in (hide, CELL, "print(1)")])
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(notebook, timeout=60, kernel_name="python3", resources=resources)
    with pytest.raises(nbclient.exceptions.CellExecutionError):
        client.execute()
    (output,) = notebook.cells[1].outputs
    assert len(output.traceback) == 1 and output.traceback[0].startswith("jaxrl-vis is not installed: ")
    assert notebook.cells[2].execution_count is None


@pytest.mark.parametrize(
    ("driver", "installed", "extra"),
    [
        (None, {}, None),
        (None, {"jax": "0.7.2"}, None),
        (580, {}, "cuda13"),
        (575, {}, "cuda12"),
        (470, {}, None),
        (580, {"jax": "0.10.1"}, "cuda13"),
        (580, {"jax": "0.10.1", "jax-cuda12-plugin": "0.10.1"}, None),
        (580, {"jax": "0.10.1", "jax-cuda13-plugin": "0.10.1"}, None),
        (580, {"jax": "0.10.1", "jax-cuda12-plugin": "0.7.2"}, "cuda12"),
        (580, {"jax": "0.7.2", "jax-cuda12-plugin": "0.7.2"}, "cuda12"),
        (550, {"jax": "0.7.2", "jax-cuda13-plugin": "0.7.2"}, "cuda12"),
    ],
)
def test_jax_for_the_gpu_fits_the_driver_and_what_is_there(driver, installed, extra, checkout):
    assert INSTALL["cuda_extra"](driver, installed, INSTALL["required_jax"](checkout)) == extra


def test_the_extras_exist(checkout):
    extras = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(INSTALL["_OLDEST_DRIVER"]) <= set(extras)


@pytest.fixture
def fake_pip(monkeypatch, tmp_path):
    """Recorded commands that would be run, and the return code and output that each gets, which tests may change."""
    calls, result = [], {"returncode": 0, "stdout": ""}

    def run(words, **options):
        if words[0] == "nvidia-smi":
            raise FileNotFoundError(words[0])
        calls.append(words)
        return subprocess.CompletedProcess(words, **result)

    monkeypatch.setattr(subprocess, "run", run)
    return calls, result


def test_what_pip_says_is_shown_where_it_fails(fake_pip, checkout, capsys):
    calls, result = fake_pip
    result.update(returncode=1, stdout="ERROR: No matching distribution\n")
    problem = INSTALL["install"](checkout)
    assert problem.startswith("pip could not install ")
    assert "ERROR: No matching distribution" in capsys.readouterr().out
    assert calls[0][-1] == str(checkout)


def test_a_replaced_package_that_was_in_use_asks_for_a_restart(fake_pip, checkout, monkeypatch):
    answers = iter([{"numpy": "1.26.0"}, {"numpy": "2.3.0", "jax": "0.10.1"}])
    monkeypatch.setitem(INSTALL["install"].__globals__, "loaded_versions", lambda: next(answers))
    problem = INSTALL["install"](checkout)
    assert "numpy" in problem and "jax" not in problem.split(":")[0] and "restart" in problem


def test_an_installation_that_went_well_says_nothing_more(fake_pip, checkout):
    assert INSTALL["install"](checkout) is None
    assert {"numpy", "pytest"} <= set(INSTALL["loaded_versions"]())


@pytest.mark.parametrize(("driver", "is_limited"), [(None, True), (470, True), (580, False)])
def test_without_a_usable_gpu_versions_that_are_slow_on_a_cpu_are_left_out(driver, is_limited, monkeypatch):
    calls = []

    def run(words, **_):
        calls.append(words)
        return subprocess.CompletedProcess(words, 0, stdout="")

    monkeypatch.setitem(INSTALL["install"].__globals__, "find_driver_version", lambda: driver)
    monkeypatch.setattr(subprocess, "run", run)
    assert INSTALL["install"](FOLDER.parent) is None
    (words,) = calls
    limits = [Path(word) for word in words if word.endswith(".in")]
    assert bool(limits) == is_limited
    for path in limits:
        assert "jax<0.11" in path.read_text().splitlines()
