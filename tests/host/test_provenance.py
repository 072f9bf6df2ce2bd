"""Provenance in runs and records, and the writing of their files."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import write_atomically


def commit(folder: Path, message: str = "more") -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("add", "-A"), (*identity, "commit", "-qm", message)):
        subprocess.run(("git", "-C", str(folder), *words), check=True)
    return subprocess.run(("git", "-C", str(folder), "rev-parse", "HEAD"), capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("JAXRL_VIS_REVISION", raising=False)
    subprocess.run(("git", "init", "-q", str(tmp_path)), check=True)
    (tmp_path / "jaxrl_vis").mkdir()
    (tmp_path / "jaxrl_vis" / "code.py").write_text("x = 1\n")
    return tmp_path


def test_the_revision_is_the_checkout_s(repository: Path) -> None:
    head = commit(repository)
    assert provenance.revision(folder=repository) == head
    assert provenance.revision(12, repository) == head[:12]
    # Somebody else's checkout says nothing about a package that lies inside.
    assert provenance.revision(folder=repository / "jaxrl_vis") is None


def test_only_code_makes_a_revision_dirty(repository: Path) -> None:
    head = commit(repository)
    (repository / "notes.txt").write_text("a run\n")
    (repository / "benchmarks" / "results").mkdir(parents=True)
    (repository / "benchmarks" / "results" / "env.json").write_text("[]")
    assert provenance.revision(folder=repository) == head
    (repository / "jaxrl_vis" / "new.py").write_text("y = 2\n")
    assert provenance.revision(12, repository) == f"{head[:12]}-dirty"


def test_no_checkout_has_no_revision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAXRL_VIS_REVISION", raising=False)
    assert provenance.revision(folder=tmp_path) is None


def test_a_copy_without_history_is_reported_its_revision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXRL_VIS_REVISION", "0123456789abcdef0123456789abcdef01234567-dirty")
    assert provenance.revision(folder=tmp_path) == "0123456789abcdef0123456789abcdef01234567-dirty"
    assert provenance.revision(12, tmp_path) == "0123456789ab-dirty"
    monkeypatch.setenv("JAXRL_VIS_REVISION", "release 1")
    assert provenance.revision(12, tmp_path) == "release 1"


def test_a_missing_library_is_said_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "PACKAGES", ("numpy", "no-such-package"))
    assert provenance.versions()["no-such-package"] == provenance.NOT_INSTALLED


def test_provenance_loads_no_jax(clean_environment: dict[str, str]) -> None:
    code = """
import sys
from jaxrl_vis.host import provenance
provenance.versions()
provenance.revision()
assert "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    write_atomically(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "\ud800")
    assert path.read_text() == "old"
    write_atomically(path, "new")
    assert path.read_text() == "new"


def test_a_write_makes_the_folders_that_are_missing(tmp_path: Path) -> None:
    write_atomically(tmp_path / "new" / "sub" / "file.json", "x")
    assert (tmp_path / "new" / "sub" / "file.json").read_text() == "x"
    with pytest.raises(OSError, match="exists|directory"):
        write_atomically(tmp_path / "new" / "sub" / "file.json" / "file", "x")
