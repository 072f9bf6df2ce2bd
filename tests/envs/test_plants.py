"""Fields of sorghum: parameters are respected, and the ground truth matches the images."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.stalks.perfect_masks import to_grey_floats
from jaxrl_vis import cli
from jaxrl_vis.stalks.phenotyping.measure.stalk import measure_stalk
from jaxrl_vis_envs import plants
from jaxrl_vis_envs.plants import SHIFTED, SHIFTS, TRAINING
from jaxrl_vis_envs.plants.family import INCH, Family, Layout, Rig, Stalks
from jaxrl_vis_envs.plants.pairs import Pair, Sequence
from jaxrl_vis_envs.plants.rendering import drawing, shading, tables
from jaxrl_vis_envs.plants.truth import HEIGHTS, outline, stalks_in_view

WIDTH = 211  # a sixteenth of the real cameras'


def changed(family, **parts):
    return dataclasses.replace(
        family, **{name: dataclasses.replace(getattr(family, name), **new) for name, new in parts.items()}
    )


BARE = changed(TRAINING, leaves=dict(density=0.0, litter=0.0), layout=dict(rows_behind=0))


@pytest.fixture(scope="module")
def plots() -> list[plants.Plot]:
    return [plants.draw(BARE, seed) for seed in range(40)]


def test_training_family_matches_the_thesis(plots):
    counts = np.array([len(plot.measured) for plot in plots])
    assert abs(counts.mean() - 33.0) < 3.0 * 6.0 / np.sqrt(40)
    assert 3.5 < counts.std() < 8.5
    stalks = [stalk for plot in plots for stalk in plot.measured]
    low, high = (np.array([1e3 * stalk.diameter(height, bare=True) for stalk in stalks]) for height in HEIGHTS)
    assert abs(low.mean() - 14.354) < 0.3
    assert 2.8 < low.std() < 3.8
    assert abs((low - high).mean() / 12.0 - 0.405) < 0.03
    assert all((stalk.radius > 0.0008).all() for stalk in stalks)
    lean = np.array([np.degrees(np.arctan2(*(stalk.points[3] - stalk.points[0])[[0, 2]])) for stalk in stalks])
    assert abs(lean.std() - 4.0) < 0.5


def test_plants_are_in_the_plot_and_keep_their_distance(plots):
    for plot in plots:
        foot = np.array([stalk.points[0] for stalk in plot.measured])
        assert (foot[:, 0] >= 0).all() and (foot[:, 0] <= 2.134).all()
        assert (np.diff(foot[:, 0]) >= 0).all()
        between = np.linalg.norm(foot[:, None] - foot[None], axis=-1) + np.eye(len(foot))
        assert between.min() > 0.01
    nearest = np.concatenate([np.diff([stalk.points[0, 0] for stalk in plot.measured]) for plot in plots])
    assert (nearest < 0.03).mean() > 0.1  # clumps


def test_nodes_are_swollen_and_sheaths_are_thick(plots):
    stalk = plots[0].measured[0]
    at_nodes = np.interp(stalk.nodes, stalk.arc, stalk.radius) / np.interp(stalk.nodes, stalk.arc, stalk.bare_radius)
    assert (at_nodes > 1.03).all() and (at_nodes < 1.4).all()
    between = 0.5 * (stalk.nodes[1:] + stalk.nodes[:-1])
    thicker = np.interp(between, stalk.arc, stalk.radius) - np.interp(between, stalk.arc, stalk.bare_radius)
    assert (thicker >= 0).all() and (thicker < 0.7e-3).all() and (thicker > 0.15e-3).any()


def test_equal_seeds_give_equal_plots():
    again = plants.draw(BARE, 3)
    first = plants.draw(BARE, 3)
    assert all((a.points == b.points).all() and (a.radius == b.radius).all() for a, b in zip(first.stalks, again.stalks))
    other = plants.draw(BARE, 4)
    assert first.stalks[0].points[0, 0] != other.stalks[0].points[0, 0]
    # The same values in another family still are other plots.
    assert plants.draw(dataclasses.replace(BARE, stream=2), 3).stalks[0].points[0, 0] != first.stalks[0].points[0, 0]


def test_families_differ_as_stated():
    assert SHIFTED.imaging.flash == (0.6, 1.6)
    assert SHIFTED.stalks.lean_sd == (4.0, 8.0)
    assert SHIFTED.imaging.noise == 2.0 * TRAINING.imaging.noise
    assert SHIFTED.stream != TRAINING.stream
    for field in dataclasses.fields(TRAINING.textures):
        seen, unseen = getattr(TRAINING.textures, field.name), getattr(SHIFTED.textures, field.name)
        assert unseen[1] <= seen[0] or unseen[0] >= seen[1], field.name
    near = changed(TRAINING, layout=dict(rows_behind=0), leaves=dict(litter=0.0))
    more = dataclasses.replace(near, leaves=dataclasses.replace(near.leaves, density=SHIFTED.leaves.density))
    ratio = sum(len(plants.draw(more, seed).leaves) for seed in range(8)) / sum(
        len(plants.draw(near, seed).leaves) for seed in range(8)
    )
    assert abs(ratio - 1.3) < 0.1
    streams = {plants.shift(TRAINING, factor).stream for factor in SHIFTS} | {TRAINING.stream, SHIFTED.stream}
    assert len(streams) == len(SHIFTS) + 2
    with pytest.raises(ValueError, match="did you mean leaves"):
        plants.shift(TRAINING, "leafs")


def test_stated_calibration_differs_by_its_error_only():
    drives = [plants.drive(SHIFTED, seed) for seed in range(60)]
    focal, baseline = (np.array([getattr(drive.true, name) for drive in drives]) for name in ("focal", "baseline"))
    assert np.abs(focal / 2168.0 - 1.0).max() <= 0.05 and np.abs(baseline / 0.1 - 1.0).max() <= 0.05
    assert np.abs(focal / 2168.0 - 1.0).max() > 0.04
    stated = np.array([drive.stated.focal / drive.true.focal for drive in drives])
    assert np.allclose(np.abs(stated - 1.0), 0.005) and len(set(np.round(stated, 6))) == 2
    assert plants.drive(TRAINING, 0).stated == plants.drive(TRAINING, 0).true
    scale = np.array([drive.odometry[-1] / (drive.poses[-1].position[0] - drive.poses[0].position[0]) for drive in drives])
    assert (np.abs(scale - 1.0) < 0.032).all() and (np.abs(scale - 1.0) > 0.008).all()
    assert len(drives[0].poses) >= 34


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("a.json", '{"stalks": {"leen_sd": [4, 5]}}', ["unknown key 'stalks.leen_sd'", "lean_sd"]),
        ("a.json", '{"stalk": {}}', ["unknown key 'stalk'", "stalks"]),
        ("a.json", '{"stalks": 3}', ["stalks must be a table"]),
        ("a.json", '{"stalks": {"lean_sd": 4}}', ["stalks.lean_sd must be a range of two numbers"]),
        ("a.json", '{"stalks": {"lean_sd": [5, 4]}}', ["stalks.lean_sd must run from low to high"]),
        ("a.json", '{"rig": {"width": 100.5}}', ["rig.width must be a whole number"]),
        ("a.json", '{"rig": {"baseline": -0.1}}', ["rig.baseline must be finite and at least 0"]),
        ("a.json", '{"layout": {"stalks_mean": 1e9}}', ["layout.stalks_mean must be from 0 to 1000"]),
        ("a.json", '{"imaging": {"samples": 3}}', ["imaging.samples must be 1 or 4"]),
        ("a.json", '{"base": "dry"}', ["base must be one of training, shifted"]),
        ("a.json", "{", ["is not JSON"]),
        ("a.json", "[" * 10**5, ["is not JSON", "levels deep"]),
        ("a.toml", "stalks = " + "[" * 10**5, ["is not TOML"]),
        ("a.toml", "stalks = [", ["is not TOML"]),
        ("a.json", "[1]", ["must hold one table"]),
        ("missing.json", None, ["missing.json cannot be read"]),
    ],
)
def test_bad_specs_raise_one_line(tmp_path, capsys, name, text, parts):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    assert cli.main(["phenotype", "synth", str(tmp_path / "out"), "--spec", str(path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert all(part in lines[0] for part in parts), lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Family(stalks=Stalks(lean_sd=2.0)), r"stalks.lean_sd must be a range, \(low, high\), got 2.0"),
        (lambda: Family(stalks=Stalks(lean_sd=(1.0, 2.0, 3.0))), "stalks.lean_sd must be a range"),
        (lambda: Family(layout=Layout(stalks_mean=(1.0, 2.0))), "layout.stalks_mean must be finite and at least 0"),
        (lambda: Family(rig=Rig(frames=2.5)), "rig.frames must be a whole number, got 2.5"),
        (lambda: Family(stalks=None), "stalks must be a Stalks, got None"),
        (lambda: Family(layout=Stalks()), "layout must be a Layout, got Stalks"),
        (lambda: Family(stream=-1), "stream must be finite and at least 0, got -1"),
        (lambda: TRAINING.at_width(100.5), "rig.width must be a whole number, got 100.5"),
        (lambda: plants.draw(TRAINING, 1.5), "seed of a plot must be a whole number of at least 0, got 1.5"),
        (lambda: plants.draw(TRAINING, -1), "seed of a plot must be a whole number of at least 0, got -1"),
        (lambda: plants.drive(TRAINING, -1), "seed of a plot must be a whole number of at least 0, got -1"),
        (lambda: plants.shift(TRAINING, ["flash"]), "there is no shift of .*did you mean flash"),
        (lambda: plants.read("missing.json"), "missing.json cannot be read"),
    ],
)
def test_bad_families_and_seeds_raise_one_line(make, said):
    with pytest.raises(ValueError, match=said) as told:
        make()
    assert "\n" not in str(told.value)


def test_specs_change_only_the_named_fields(tmp_path):
    path = tmp_path / "wild.toml"
    path.write_text('base = "shifted"\n[stalks]\nlean_sd = [1, 2]\n[rig]\nframes = 40\n')
    family = plants.read(path)
    assert family.name == "wild" and family.stalks.lean_sd == (1.0, 2.0) and family.rig.frames == 40
    assert family.leaves == SHIFTED.leaves
    assert family.stream not in (TRAINING.stream, SHIFTED.stream)


# --- images ---


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    family = changed(TRAINING, layout=dict(rows_behind=1, stalks_mean=14.0, stalks_sd=0.0), leaves=dict(litter=5.0))
    family = changed(family.at_width(WIDTH), rig=dict(frames=34), stalks=dict(diameter_mean=0.02))
    return Sequence.of(plants.draw(family, 1))


@pytest.fixture(scope="module")
def pair(sequence) -> Pair:
    return sequence[16]


def test_images_are_deterministic(sequence, pair):
    again = Sequence.of(plants.draw(sequence.plot.family, 1))[16]
    assert pair.left.shape == (169, WIDTH, 3) and pair.left.dtype == np.uint8
    assert (np.asarray(again.left) == np.asarray(pair.left)).all() and (np.asarray(again.right) == np.asarray(pair.right)).all()
    assert (np.asarray(pair.left) != np.asarray(pair.right)).any()


def test_disparity_times_depth_is_focal_length_times_baseline(sequence, pair):
    true = sequence.drive.true
    depth, disparity = np.asarray(pair.depth), np.asarray(pair.disparity)
    seen = np.isfinite(depth)
    assert seen.any()
    np.testing.assert_allclose(depth[seen] * disparity[seen], true.focal * true.baseline, rtol=1e-5)
    assert (disparity[~seen] == 0).all()


def crossings(points: np.ndarray, row: float) -> float:
    """Return the column at which an edge [K, 2] crosses a row."""
    order = np.argsort(points[:, 1])
    return float(np.interp(row, points[order, 1], points[order, 0]))


def test_mask_edges_match_the_true_diameter(sequence, pair):
    """A mask contains the pixels whose centres a stalk covers, so its edges are within half a pixel of the true ones."""
    instance, checked = np.asarray(pair.instance), []
    for index, stalk in enumerate(sequence.plot.measured):
        edges = outline(stalk, pair.pose, sequence.drive.true, np.linspace(0.0, 1.3, 500))
        for row in range(10, 130, 5):
            left, right = (crossings(edges[:, side], row) for side in (0, 1))
            columns = np.flatnonzero(instance[row] == index)
            # Where something stands before it, its mask ends earlier.
            if columns.size and left > 1 and right < WIDTH - 2 and abs(columns.size - (right - left)) < 1.5:
                checked.append((columns[0] - 0.5 - left, columns[-1] + 0.5 - right))
    errors = np.array(checked)
    assert len(errors) > 40
    assert abs(errors[:, 1] - errors[:, 0]).mean() < 0.5
    assert abs((errors[:, 1] - errors[:, 0]).mean()) < 0.12
    assert np.quantile(abs(errors), 0.95) < 0.55


def test_outline_width_matches_the_diameter(sequence, pair):
    """Tangents to a circle of radius r at distance D are 2 f r / sqrt(D^2 - r^2) apart in the image's middle."""
    true, stalk = sequence.drive.true, sequence.plot.measured[7]
    upright = np.zeros_like(stalk.points)
    upright[:, 0], upright[:, 2] = pair.pose.position[0], stalk.arc
    stalk = dataclasses.replace(stalk, points=upright, ovality=1.0, radius=np.full_like(stalk.arc, 0.01))
    pose = dataclasses.replace(pair.pose, rotation=np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]))
    edges = outline(stalk, pose, true, np.array([0.3]))
    distance = -pose.position[1]
    assert edges[0, 1, 0] - edges[0, 0, 0] == pytest.approx(2 * true.focal * 0.01 / np.sqrt(distance**2 - 1e-4), rel=1e-6)
    assert stalk.diameter(0.3) == pytest.approx(0.02)


def test_boxes_are_tight_and_visibility_is_a_fraction(sequence, pair):
    instance, depth = np.asarray(pair.instance), np.asarray(pair.depth)
    found = stalks_in_view(sequence.plot, pair.pose, sequence.drive.true, instance, depth)
    assert len(found) >= 4
    for stalk in found:
        row, column = np.nonzero(instance == stalk.stalk)
        assert stalk.pixels == row.size
        if stalk.visible_box is not None:
            assert stalk.visible_box == (column.min() - 0.5, row.min() - 0.5, column.max() + 0.5, row.max() + 0.5)
            # What is seen is inside of what is there, but for half a pixel.
            bounds = np.array(stalk.box) + np.array([-1.0, -1.0, 1.0, 1.0])
            assert (np.array(stalk.visible_box)[:2] >= bounds[:2]).all() and (
                np.array(stalk.visible_box)[2:] <= bounds[2:]
            ).all()
        assert 0.0 <= stalk.visible <= 1.0 and 0.0 <= stalk.band_visible <= 1.0
    assert max(stalk.visible for stalk in found) > 0.6
    assert {stalk.stalk for stalk in found if stalk.pixels} == set(instance[instance >= 0]) & set(
        range(len(sequence.plot.measured))
    )


def test_a_stalk_keeps_its_identity_over_frames(sequence, pair):
    """The visible part of a stalk in one image, shifted by the camera's step, is on the same stalk in the next."""
    following = sequence[17]
    true = sequence.drive.true
    instance, depth = np.asarray(pair.instance), np.asarray(pair.depth)
    after = np.asarray(following.instance)
    agree = total = 0
    for index in range(len(sequence.plot.measured)):
        row, column = np.nonzero(instance == index)
        x, y = (column - true.centre[0]) / true.focal, (row - true.centre[1]) / true.focal
        camera = np.stack([x, y, np.ones_like(x)], axis=1) * depth[row, column][:, None]
        moved = following.pose.to_camera(pair.pose.to_world(camera))
        places = np.round(moved[:, :2] / moved[:, 2:] * true.focal + np.array(true.centre)).astype(int)
        inside = (places >= 1).all(axis=1) & (places < np.array([WIDTH, 169]) - 1).all(axis=1)
        ids = after[places[inside, 1], places[inside, 0]]
        agree += int((ids == index).sum())
        total += ids.size
    assert total > 500
    assert agree / total > 0.85  # the rest is hidden by something else in the next image, or at an edge


def test_the_ground_is_flat_and_visible(sequence, pair):
    row, column = np.nonzero(np.asarray(pair.instance) == -2)
    true = sequence.drive.true
    x, y = (column - true.centre[0]) / true.focal, (row - true.centre[1]) / true.focal
    points = np.stack([x, y, np.ones_like(x)], axis=1) * np.asarray(pair.depth)[row, column][:, None]
    assert row.size > 1000
    assert np.abs(pair.pose.to_world(points)[:, 2]).max() < 1e-4


def test_synth_writes_plots_and_resumes(tmp_path, capsys):
    out, spec = tmp_path / "plots", tmp_path / "thin.json"
    spec.write_text('{"layout": {"rows_behind": 0, "stalks_mean": 12}, "leaves": {"density": 0.5}}')
    words = [
        "phenotype",
        "synth",
        str(out),
        "--spec",
        str(spec),
        "--width",
        str(WIDTH),
        "--frames",
        "1",
        "--plots",
        "2",
        "--seed",
        "5",
    ]
    assert cli.main(words) == 0
    first = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    names = {path.relative_to(out / "plot_0005").as_posix() for path in first if "plot_0005" in path.parts}
    assert names == {
        *("left_000.png", "right_000.png", "calibration.yaml", "odometry.csv", "annotations.json", "plot.json"),
        *("truth/instance_000.png", "truth/disparity_000.png"),
    }
    (out / "plot_0006" / "plot.json").unlink()
    (out / "plot_0006" / "left_000.png").write_bytes(b"half of it")
    assert cli.main(words) == 0
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == first
    assert "1 there already" in capsys.readouterr().out
    assert cli.main(["phenotype", "synth", str(out), "--family", "shifted"]) == 2
    assert "another family" in capsys.readouterr().err

    from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
    from jaxrl_vis.stalks.phenotyping.io.images import read_image
    from jaxrl_vis.stalks.phenotyping.io.masks import decode_mask

    plot = out / "plot_0005"
    truth, coco = (json.loads((plot / name).read_text()) for name in ("plot.json", "annotations.json"))
    assert truth["synthetic"] and truth["count"] == len(truth["stalks"])
    instance = read_image(plot / "truth" / "instance_000.png")
    for each in coco["annotations"]:
        assert (decode_mask(each["segmentation"]) == (instance == each["stalk"] + 1)).all()
    stated = read_calibration(plot / "calibration.yaml")
    assert stated.focal == pytest.approx(truth["stated_cameras"]["focal"])
    assert stated.baseline == pytest.approx(truth["stated_cameras"]["baseline"])
    disparity = read_image(plot / "truth" / "disparity_000.png") / truth["disparity_scale"]
    near = stated.depth(np.median(disparity[instance > 0]))
    assert 0.6 < near < 1.8


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--plots", "0"], "--plots must be at least 1"),
        (["--seed", "-1"], "--seed must be at least 0"),
        (["--shift", "lien"], "there is no shift of 'lien'; did you mean lean"),
        (["--spec", "x.json", "--shift", "lean"], "leave out --family and --shift"),
        (["--width", "8"], "rig.width must be from 32 to 20000"),
        (["--format", "bmp"], "--format cannot be 'bmp'"),
    ],
)
def test_bad_arguments_of_synth(tmp_path, capsys, words, part):
    assert cli.main(["phenotype", "synth", str(tmp_path / "out"), *words]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and part in lines[0], lines


def test_a_stalk_height_of_twelve_inches(plots):
    stalk = plots[0].measured[0]
    middle, _ = stalk.at_height(12 * INCH)
    assert middle[2] == pytest.approx(12 * INCH)


def test_batched_and_sequential_tiles_agree(sequence):
    """Batches, as used on an accelerator, render the same image as sequential tiles, as used on a CPU."""
    true, pose = sequence.drive.true, sequence.drive.poses[16]
    view = tables.build_view(sequence.surfaces, pose, true)
    numbers = (true.focal, true.centre, (0.0, 0.0), pose.rotation, pose.position, (0.05, -0.1, 0.0), (1.0, 0.01, 0.8))
    shot = shading.Shot(*(jnp.asarray(number, jnp.float32) for number in numbers))
    one, many = (drawing.render_view(view, shot, true.width, true.height, 1, at_once) for at_once in (1, 20))
    for left, right in zip(one, many):
        assert np.isclose(np.asarray(left), np.asarray(right), atol=1e-4).mean() > 0.999


@pytest.fixture(scope="module")
def close_up() -> Sequence:
    """Cameras at half the real resolution that see only the 0.31 m around 12 inches."""
    family = changed(TRAINING, layout=dict(rows_behind=1, stalks_mean=20.0, tillers=0.0), leaves=dict(density=0.3, litter=0.0))
    return Sequence.of(plants.draw(changed(family, rig=dict(width=422, height=338, focal=1084.0)), 2))


def test_a_pair_gives_diameters_in_millimetres(close_up):
    """With true masks and our own disparity and widths, the remaining error is below the pixel size of 0.74 mm."""
    drive, errors = close_up.drive, []
    for frame in (8, 13, 18, 23):
        pair = close_up[frame]
        instance, left, right = (
            np.asarray(pair.instance),
            to_grey_floats(np.asarray(pair.left)),
            to_grey_floats(np.asarray(pair.right)),
        )
        for index, stalk in enumerate(close_up.plot.measured):
            row, column = np.nonzero(instance == index)
            if row.size < 1000 or column.min() < 175 or column.max() > 400:
                continue  # the right camera does not see it, or neither sees all of it
            corner = (int(row.min()), int(column.min()) - 2)
            mask = instance[corner[0] : row.max() + 1, corner[1] : column.max() + 3] == index
            found = measure_stalk(mask, corner, left, right, drive.true)
            assert not found.reason, found.reason
            rows = outline(stalk, pair.pose, drive.true, np.linspace(0.1, 0.6, 501))[:, :, 1].mean(axis=1)
            height = float(np.linspace(0.1, 0.6, 501)[np.argmin(np.abs(rows - found.row))])
            assert found.depth == pytest.approx(-pair.pose.position[1] + stalk.at_height(height)[0][1], abs=0.02)
            if found.confidence > 0.6 and stalk.node_distance(height) > 0.01:
                errors.append(found.diameter_mm - 1e3 * stalk.diameter(height))
    assert len(errors) >= 3
    assert np.abs(errors).mean() < 0.6 and np.abs(errors).max() < 1.2


@pytest.mark.parametrize("count", [0, 1, 2])
def test_small_plots_have_the_requested_number_of_stalks(count):
    few = changed(BARE, layout=dict(stalks_mean=float(count), stalks_sd=0.0, tillers=0.9))
    assert {len(plants.draw(few, seed).measured) for seed in range(10)} == {count}
