"""`make verify-release` and `doctor --report`: what they compare, and what they write."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from benchmarks import verify_release
from benchmarks.ledger.tables import platforms
from jaxrl_vis import cli
from jaxrl_vis.host import doctor, platform_report

SECONDS = 1_700_000_000


def archive(path: Path, files: dict[str, str], year: int = 2026) -> Path:
    with zipfile.ZipFile(path, "w") as written:
        for name, text in files.items():
            written.writestr(zipfile.ZipInfo(name, (year, 1, 1, 0, 0, 0)), text)
    return path


def test_differences_are_reported_file_by_file(tmp_path: Path) -> None:
    one = archive(tmp_path / "one.whl", {"a.py": "1", "b.py": "2"})
    assert list(verify_release.differences(one, archive(tmp_path / "same.whl", {"a.py": "1", "b.py": "2"}))) == []
    (changed,) = verify_release.differences(one, archive(tmp_path / "other.whl", {"a.py": "1", "b.py": "3"}))
    assert changed.startswith("one.whl: b.py is (1, ")
    assert len(list(verify_release.differences(one, archive(tmp_path / "later.whl", {"a.py": "1", "b.py": "2"}, 2027)))) == 2
    (missing,) = verify_release.differences(one, archive(tmp_path / "less.whl", {"a.py": "1"}))
    assert missing.endswith("and missing")
    (order,) = verify_release.differences(one, archive(tmp_path / "order.whl", {"b.py": "2", "a.py": "1"}))
    assert order.endswith("packed otherwise")


def test_builds_are_equal_whatever_the_folder_and_the_time_of_its_files(tmp_path: Path, checkout: Path) -> None:
    pytest.importorskip("build")
    builds = []
    for number, name in enumerate(("one", "another")):
        source = tmp_path / name
        source.mkdir()
        for kept in ("pyproject.toml", "README.md", "LICENSE", "NOTICE", "CHANGELOG.md"):
            shutil.copyfile(checkout / kept, source / kept)
        for package in ("jaxrl_vis", "envs/jaxrl_vis_envs"):  # a few files of each: it is about how they are packed
            (source / package).mkdir(parents=True)
            for file in sorted((checkout / package).glob("*.py"))[:: 1 - 2 * number]:
                shutil.copyfile(file, source / package / file.name)
        builds.append(verify_release.build(source, tmp_path / f"{name}-dist", SECONDS))
    assert [path.suffix for path in builds[0]] == [".whl", ".gz"]
    for first, second in zip(*builds, strict=True):
        assert list(verify_release.differences(first, second)) == []
    wheel = builds[0][0]
    later = verify_release.build(tmp_path / "one", tmp_path / "later", SECONDS + 60)[0]
    assert list(verify_release.differences(wheel, later)), "it is the time of the commit that counts"


def test_a_commit_is_exported_without_what_is_not_committed(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    repository.mkdir()
    (repository / "kept.txt").write_text("kept")
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-qm", "one", "--date", "2026-01-01T00:00:00Z"]):
        if subprocess.run(["git", *words], cwd=repository, capture_output=True).returncode:
            pytest.skip("git cannot commit here")
    (repository / "kept.txt").write_text("changed")
    (repository / "secret.txt").write_text("not committed")
    verify_release.export(repository, tmp_path / "exported")
    assert {path.name: path.read_text() for path in (tmp_path / "exported").iterdir()} == {"kept.txt": "kept"}
    assert verify_release.commit_time(repository) > SECONDS


def test_the_bill_of_materials_names_packages_and_no_place(tmp_path: Path, checkout: Path) -> None:
    pytest.importorskip("cyclonedx_py")
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    for name, needs in (("thing", "jaxrl-vis"), ("jaxrl-vis", "thing"), ("pip", "thing")):
        folder = site / f"{name.replace('-', '_')}-1.5.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.5\nRequires-Dist: {needs}\n")
        (folder / "direct_url.json").write_text(json.dumps({"url": f"file://{tmp_path}/{name}.whl", "archive_info": {}}))
    path = tmp_path / "bill.json"
    verify_release.bill_of_materials(python, checkout, path)
    bill = json.loads(path.read_text())
    assert bill["bomFormat"] == "CycloneDX" and bill["metadata"]["component"]["name"] == "jaxrl-vis"
    assert [(component["name"], component["version"]) for component in bill["components"]] == [("thing", "1.5")]
    refs = {bill["components"][0]["bom-ref"], bill["metadata"]["component"]["bom-ref"]}
    assert {dependency["ref"] for dependency in bill["dependencies"]} == refs
    assert "file:" not in path.read_text() and str(tmp_path) not in path.read_text()
    assert "serialNumber" not in bill and "timestamp" not in bill["metadata"], "another bill of the same would differ"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checks that take no time, of which one fails, and a training that only returns its results."""

    def train(self: platform_report.Training) -> str:
        self.results = {"task": "Thing", "preset": "debug", "env_steps": 8, "env_steps_per_s": 1234.5, "wall_s": 1.0}
        return "8 steps"

    def broken() -> str:
        raise ValueError("no picture")

    monkeypatch.setattr(doctor, "CHECKS", (("versions", doctor.versions), ("renderer", broken)))
    monkeypatch.setattr(platform_report.Training, "__call__", train)


@pytest.mark.usefixtures("quick")
def test_a_report_is_a_row_of_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / platforms.FOLDER).mkdir()
    assert platforms.platforms_table(tmp_path) is None
    assert cli.main(["doctor", "--report", str(tmp_path / platforms.FOLDER)]) == 1
    assert "FAIL  renderer" in capsys.readouterr().out
    (file,) = (tmp_path / platforms.FOLDER).iterdir()
    record = json.loads(file.read_text())
    assert record["checks"] == {"versions": True, "renderer": False, "training": True}
    assert record["backend"] == "cpu" and record["accelerator"] is None and file.suffix == ".json"
    table = platforms.platforms_table(tmp_path)
    assert table is not None
    row = table.splitlines()[-1]
    assert "doctor: 2 of 3 checks (failed: renderer); Thing, debug: 1,234 steps/s" in row
    assert record["versions"]["jax"] in row and record["date"] in row


@pytest.mark.usefixtures("quick")
def test_a_report_goes_where_it_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--report", str(tmp_path / "new" / "here.json")]) == 1
    assert (tmp_path / "new" / "here.json").exists()
    (tmp_path / "file").write_text("")
    assert cli.main(["doctor", "--report", str(tmp_path / "file" / "here.json")]) == 2
    assert "--report" in capsys.readouterr().err


def test_a_renderer_that_is_wrong_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    from jaxrl_vis_envs import render

    assert "right" in doctor.renderer()
    original: Any = render.render
    monkeypatch.setattr(render, "render", lambda *given: (frame := original(*given))._replace(depth=frame.depth * 1.01))
    with pytest.raises(ValueError, match="depths are 1.5150 and 2.0200 m"):
        doctor.renderer()
