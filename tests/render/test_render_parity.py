"""Renderer against MuJoCo's own, model by model, with stored images: no GL is needed.

The bounds are those of the live comparison (benchmarks/render_parity.py), on fewer and smaller images. A model without stored
images fails, and so does one whose package has changed since they were made.
"""

import mujoco
import numpy as np
import pytest
import render_models
import render_references
from render_comparison import BARE, BOUNDS, PLANE, SKY, TEXTURED, Tally, surface_kinds

from jaxrl_vis.bench.scenes.models import forward
from jaxrl_vis_envs.render import Frame

MANY_TRIANGLES = 100_000  # so many take longer to draw than a fast program takes to compile


@pytest.mark.parametrize("name", render_models.MODELS)
def test_images_agree_with_mujoco(name: str) -> None:
    stored = render_references.load(name)
    mj_model, camera = render_models.build(name)
    assert render_models.fingerprint(mj_model) == stored.fingerprint, (
        f"{name} is not what was drawn: its package has changed, so run tests/make_render_references.py {name}"
    )
    height, width = stored.depth.shape[1:]
    scene = render_models.make_scene(name, mj_model, camera, height, width)
    mj_data = mujoco.MjData(mj_model)
    poses = []
    for qpos, position, quaternion in zip(stored.qpos, stored.mocap_pos, stored.mocap_quat, strict=True):
        mj_data.qpos, mj_data.mocap_pos, mj_data.mocap_quat = qpos, position, quaternion
        forward(mj_model, mj_data)
        poses.append(render_models.poses_of(mj_data))
    tally = Tally(surface_kinds(mj_model))
    quick = len(scene.triangles) < MANY_TRIANGLES
    for index, ours in enumerate(render_models.draw(scene, poses, quick)):
        theirs = Frame(stored.rgb[index], stored.depth[index], stored.segmentation[index])  # pyright: ignore[reportArgumentType]
        tally.add(ours, theirs)
    assert len({row.tobytes() for row in stored.rgb}) == len(poses), "the stored images are copies of each other"
    assert tally.solid > 0, "nothing was compared"
    failures = tally.failures(render_models.MODELS[name].limits)
    assert not failures, {measure: tally.measures()[measure] for measure in failures}


def frame(label: int = 0, depth: float = 2.0, colour: int = 100) -> Frame:
    """Return a uniform image of 16 x 16 pixels, with sky in the right half."""
    labels = np.full((16, 16), label, np.int32)
    labels[:, 8:] = -1
    rgb = np.full((16, 16, 3), colour, np.uint8)
    return Frame(rgb, np.full((16, 16), depth, np.float32), labels)  # pyright: ignore[reportArgumentType]


def tally_of(ours: Frame, theirs: Frame, kind: str = BARE) -> Tally:
    tally = Tally(np.array([kind, kind]))
    tally.add(ours, theirs)
    return tally


def test_an_image_agrees_with_itself_away_from_edges() -> None:
    tally = tally_of(frame(), frame())
    assert tally.failures() == []
    assert (tally.kept, tally.solid) == (16 * 14, 16 * 7)  # one pixel each side of the edge is left out
    assert tally.measures()["iou"] == tally.measures()["segmentation"] == tally.measures()["depth"] == 1.0


def test_another_object_fails() -> None:
    assert tally_of(frame(label=1, depth=2.001), frame(label=0)).failures() == ["segmentation", "iou", "matched"]


def thin(width: int, column: int = 3, label: int = 1) -> Frame:
    """Return `frame` with a geom of a few columns and twelve rows, all of whose pixels are near its edges."""
    changed = frame()
    changed.segmentation[2:14, column : column + width] = label
    changed.rgb[2:14, column : column + width] = 255
    return changed


def test_a_thin_object_that_is_missing_fails_in_both_directions() -> None:
    for ours, theirs in ((frame(), thin(2)), (thin(2), frame())):
        tally = tally_of(ours, theirs)
        assert tally.failures() == ["matched"]
        assert tally.worst_match == (0.0, 1, 0)


def test_a_thin_object_may_be_a_pixel_away_and_no_further() -> None:
    assert tally_of(thin(1), thin(1, column=4)).failures() == []
    assert tally_of(thin(1), thin(1, column=5)).failures() == ["matched"]
    assert tally_of(thin(1), thin(3, column=2)).measures()["matched"] == 1.0  # wider by a pixel on each side
    assert "matched" in tally_of(thin(1), thin(4)).failures()


def test_either_of_two_coincident_surfaces_may_be_rendered() -> None:
    other, nearer = thin(1), thin(1)
    other.segmentation[other.segmentation == 1] = 0  # the same image, by the name of the object behind
    assert tally_of(thin(1), other).failures() == []
    nearer.segmentation[nearer.segmentation == 1] = 0
    nearer.depth[2:14, 3] -= 0.001  # within the bound of depths, but one surface lies before the other
    assert tally_of(thin(1), nearer).failures() == ["matched"]


def test_a_wrong_object_inside_counts_though_edges_are_left_out() -> None:
    ours = frame()
    ours.segmentation[4:12, 2:6] = 1
    tally = tally_of(ours, frame())
    assert {"segmentation", "iou"} <= set(tally.failures())
    assert tally.worst[1:] == (0, 0)


@pytest.mark.parametrize("depth", [2.0021, 1.997, np.nan])
def test_depth_tolerance_is_a_millimetre_or_a_thousandth(depth: float) -> None:
    assert tally_of(frame(depth=2.0019), frame()).failures() == []
    assert tally_of(frame(depth=depth), frame()).failures() == ["depth"]
    assert tally_of(frame(depth=0.0509), frame(depth=0.05)).failures() == []


@pytest.mark.parametrize(
    ("kind", "difference", "failures"),
    [
        (BARE, 4, []),
        (BARE, 5, ["bare_mean"]),
        (BARE, 13, ["bare_mean", "bare_p99"]),
        (TEXTURED, 8, []),
        (TEXTURED, 9, ["textured_mean"]),
        (PLANE, 50, []),
    ],
)
def test_colour_bounds_depend_on_the_kind_of_surface(kind: str, difference: int, failures: list[str]) -> None:
    ours = frame()
    ours.rgb[:, :8] -= np.uint8(difference)
    tally = tally_of(ours, frame(), kind)
    assert tally.failures() == failures
    assert tally.measures()[f"{kind}_mean"] == difference
    assert tally.measures()[f"{SKY}_mean"] == 0.0


def test_every_bound_is_measured() -> None:
    assert set(BOUNDS) <= set(tally_of(frame(), frame()).measures())


def test_packing_is_accurate_enough(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_references, "FOLDER", tmp_path)
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 300, (2, 5, 7)).astype(np.int32)
    depth = np.where(labels < 0, 50.0, np.exp(rng.uniform(np.log(0.02), np.log(49.0), labels.shape))).astype(np.float32)
    rgb = rng.integers(0, 256, (2, 5, 7, 3)).astype(np.uint8)
    poses = rng.normal(size=(2, 4)), np.zeros((2, 0, 3)), np.zeros((2, 0, 4))
    render_references.save("model", render_references.References(7, *poses, rgb, depth, labels, 0.01, 50.0))
    loaded = render_references.load("model")
    np.testing.assert_array_equal(loaded.rgb, rgb)
    np.testing.assert_array_equal(loaded.segmentation, labels)
    np.testing.assert_array_equal(loaded.qpos, poses[0])
    np.testing.assert_allclose(loaded.depth, depth, rtol=1e-4)
    assert loaded.fingerprint == 7 and (loaded.near, loaded.far) == (0.01, 50.0)


def test_missing_references_fail() -> None:
    with pytest.raises(FileNotFoundError, match="make_render_references.py nothing"):
        render_references.load("nothing")
