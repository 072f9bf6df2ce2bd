"""Verdicts of `benchmarks/render_parity.py FOLDER` on third-party models. No GL is needed."""

import mujoco
import numpy as np

from benchmarks.rendering import model_folder
from jaxrl_vis_envs.render import Frame


def frame(labels: np.ndarray, colour: int = 100, depth: float = 2.0) -> Frame:
    """Return an image with segmentation ``labels`` [H, W], of one colour and depth."""
    rgb = np.full((*labels.shape, 3), colour, np.uint8)
    return Frame(rgb, np.full(labels.shape, depth, np.float32), labels)  # pyright: ignore[reportArgumentType]


def verdict(ours: Frame, theirs: Frame, hidden: np.ndarray | None = None) -> list[str]:
    return model_folder.measure(ours, theirs, np.zeros((32, 32), bool) if hidden is None else hidden).failures()


def test_equal_images_pass_and_failures_name_the_measure() -> None:
    labels = np.full((32, 32), -1, np.int32)
    labels[4:28, 4:28] = 0
    small = labels.copy()
    small[10:16, 10:16] = 1
    assert verdict(frame(labels), frame(labels)) == []
    assert verdict(frame(labels, colour=106), frame(labels)) == ["rgb"]
    assert verdict(frame(labels, colour=120), frame(labels), np.ones((32, 32), bool)) == []
    assert verdict(frame(labels, depth=2.1), frame(labels)) == ["depth"]
    assert "missing (1,)" in verdict(frame(labels, depth=2.1), frame(small))
    # Where depth and colour are the same, either of two objects will do.
    assert verdict(frame(labels), frame(small)) == []


def test_rows_of_a_model_are_its_cameras_its_sites_and_its_haze() -> None:
    xml = """<mujoco><asset><texture type="skybox" builtin="flat" width="4" height="4"/></asset>
      <worldbody><geom type="plane" size="0 0 1"/><site/><camera name="{name}"/></worldbody></mujoco>"""
    for name, titles in (
        ("cam", ["cam", "cam + sites", "cam + haze"]),
        ("eye", ["free", "eye", "free + sites", "free + haze"]),
    ):
        mj_model = mujoco.MjModel.from_xml_string(xml.format(name=name))
        assert [view.title(mj_model) for view in model_folder.views(mj_model)] == titles


def test_invalid_models_have_their_own_verdict(tmp_path, capsys) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "broken.xml").write_text("<mujoco><worldbody>")
    (tmp_path / "notes.txt").write_text("not looked at")
    assert model_folder.report(tmp_path, 32, None) == 0
    shown = capsys.readouterr().out
    assert "| deep/broken.xml |" in shown and "not loaded: " in shown and "1 rows of 1 files, 0 failed" in shown
