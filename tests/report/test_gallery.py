"""Tests of `jaxrl-vis envs`: the table of environments, and the sheet of images."""

from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image
from point_mass import PointMass, PointMassConfig

import jaxrl_vis_envs
from jaxrl_vis import cli
from jaxrl_vis.report import gallery
from jaxrl_vis_envs import registry


@pytest.fixture
def own_environment() -> Iterator[str]:
    """Name of a user's environment, registered for the duration of a test."""
    registry.register("VisualOwnMass", PointMass, PointMassConfig)
    yield "VisualOwnMass"
    del registry._ENTRIES["VisualOwnMass"]


def rows(output: str) -> dict[str, list[str]]:
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if line.startswith("│")]
    return {cell[0]: cell[1:] for cell in cells}


def test_the_table_says_what_the_environments_are(own_environment: str, capsys: pytest.CaptureFixture[str]) -> None:
    traced = []
    with pytest.MonkeyPatch.context() as patch:
        for part in ("reset", "advance"):  # the table is quick because it asks for neither
            patch.setattr(PointMass, part, lambda *_: traced.append(1))
        assert cli.main(["envs"]) == 0
    assert not traced
    table = rows(capsys.readouterr().out)
    assert list(table) == jaxrl_vis_envs.list_envs()
    assert table["VisualFingerTurn"][:6] == ["2", "12x64x64 uint8", "2", "50", "0.07 m", "210 ms"]
    assert table["HandReach"][:6] == ["20", "63 float32", "15", "50", "0.03 m", "40 ms"]
    for name, cells in table.items():
        assert (cells[6:] == ["-", "-"]) == (name == own_environment), name  # nobody has measured the user's
        assert cells[6:] == table[name.removeprefix("Visual")][6:] if name != own_environment else True


def test_the_table_of_some_environments(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["envs", "--env", "Reacher", "FetchReach"]) == 0
    assert list(rows(capsys.readouterr().out)) == ["Reacher", "FetchReach"]


def test_the_gallery_shows_start_and_goals(own_environment: str, tmp_path: Path) -> None:
    size, goals = 20, 3
    path = tmp_path / "gallery.png"
    options = ["--gallery", str(path), "--image-size", str(size), "--goals", str(goals)]
    assert cli.main(["envs", "--env", own_environment, *options]) == 0
    sheet = np.asarray(Image.open(path))
    assert sheet.shape[0] > size and sheet.shape[1] > (4 + goals) * size
    frames = gallery.render_poses(jaxrl_vis_envs.make(own_environment), jax.random.key(1), goals, size)
    assert frames.rgb.shape == (1 + goals, size, size, 3)
    for labels in frames.segmentation:
        assert set(np.unique(labels)) == {0, 1}  # ground and ball
    # The sheet holds those images: start and goals are all different, and each is found where it belongs.
    assert len({image.tobytes() for image in frames.rgb}) == 1 + goals
    for image in frames.rgb:
        windows = np.lib.stride_tricks.sliding_window_view(sheet, image.shape)[:, :, 0]
        assert (windows == image).all(axis=(2, 3, 4)).any()


def test_what_the_gallery_cannot_draw_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for tokens, word in (
        (["--env", "Reacher", "--gallery", str(tmp_path / "x.png")], "VisualReacher"),
        (["--env", "VisualReacher", "--gallery", str(tmp_path / "x.txt")], ".png"),
    ):
        assert cli.main(["envs", *tokens]) == 2
        assert word in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["sheet.psd", "sheet.fits", "sheet.xbm", "sheet.zzz", "sheet"])
def test_a_format_that_cannot_be_written_is_refused_before_the_work(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pillow cannot write colour images in the first three formats, but raises an error only after rendering."""
    assert cli.main(["envs", "VisualReacher", "--gallery", str(tmp_path / name)]) == 2
    assert "end its name in .png or .jpg" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_an_environment_that_is_named_twice_has_one_row(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    assert (
        cli.main(["envs", "VisualReacher", "VisualReacher", "--gallery", str(sheet), "--goals", "1", "--image-size", "16"]) == 0
    )
    assert Image.open(sheet).height < 2 * 16 + 40
