"""Tests from folders of pairs to stalks: pairing of images, tracking of sightings, widths, and scores of detections."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odometry_of_plot import read_odometry

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import PlotScore, average_precision, match_detections, summarize_scores
from jaxrl_vis.stalks.phenotyping.evaluation.thesis import count_by_length, mean_widths
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import odometry_fault, read_odometries
from jaxrl_vis.stalks.phenotyping.measure.stalk import Measurement
from jaxrl_vis.stalks.phenotyping.track.direction import track_either_way
from jaxrl_vis.stalks.phenotyping.track.follow import Track, track_stalks
from jaxrl_vis.stalks.phenotyping.track.heights import USUAL_TAPER, StalkWidths, robust_width, stalk_widths
from jaxrl_vis.stalks.phenotyping.track.near_row import near_row_depth
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting, _occluded_edges
from jaxrl_vis_envs.plants import Calibration
from jaxrl_vis_envs.plants.truth import StalkInView

BLANK = np.full((12, 16, 3), 80, np.uint8)
CAMERAS = Calibration(1500, 1200, 1000.0, (749.5, 600.0), 0.1)


# --- folders ---


@pytest.mark.parametrize(
    "names",
    [
        ("left_2.png", "right_2.png", "left_10.png", "right_10.png"),
        ("row-2-L.JPG", "row-2-R.JPG", "row-10-L.JPG", "row-10-R.JPG"),
        ("left/2.tif", "right/2.tif", "left/10.tif", "right/10.tif"),
        ("Left/2.tif", "Right/2.tif", "Left/10.tif", "Right/10.tif"),
        ("L/2.tif", "R/2.tif", "L/10.tif", "R/10.tif"),
        ("R2_left_2.png", "R2_right_2.png", "R2_left_10.png", "R2_right_10.png"),
        ("plot_R1_L_2.png", "plot_R1_R_2.png", "plot_R1_L_10.png", "plot_R1_R_10.png"),
        ("L_r3_2.png", "R_r3_2.png", "L_r3_10.png", "R_r3_10.png"),
    ],
)
def test_pairs_are_found_by_their_names(tmp_path, names):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "left_notes.txt").touch()
    (tmp_path / "disparity_left_2.png").touch()
    (plot,) = find_plots(tmp_path)
    assert [pair.name[-2:].strip("-_") for pair in plot.pairs] == ["2", "10"]
    assert [(pair.left.name, pair.right.name) for pair in plot.pairs] == [  # pyright: ignore[reportOptionalMemberAccess]
        (Path(names[0]).name, Path(names[1]).name),
        (Path(names[2]).name, Path(names[3]).name),
    ]


def test_folders_of_folders_and_folders_of_nothing(tmp_path):
    for plot in ("b", "a"):
        (tmp_path / plot).mkdir()
        (tmp_path / plot / "left_0.png").touch()
    (tmp_path / "notes").mkdir()
    plots = find_plots(tmp_path)
    assert [plot.name for plot in plots] == ["a", "b"] and plots[0].pairs[0].right is None
    with pytest.raises(RequestError, match="holds no stereo pairs"):
        find_plots(tmp_path / "notes")
    with pytest.raises(RequestError, match="there is no folder"):
        find_plots(tmp_path / "missing")


def test_odometry_by_distance_time_and_name(tmp_path):
    for side in ("left", "right"):
        for number in range(2):
            (tmp_path / f"{side}_{number}.png").touch()
    (plot,) = find_plots(tmp_path)
    assert read_odometry(plot) is None
    table = tmp_path / "odometry.csv"
    table.write_text("left,distance_m\nleft_1.png,0.5\nleft_0.png,0.25\n")
    assert read_odometry(plot) == {"0": 0.25, "1": 0.5}
    table.write_bytes("\ufeffleft, distance_m\r\nraw/left_1.png,0.5\r\nleft_0.png,0.25\r\n".encode())
    assert read_odometry(plot) == {"0": 0.25, "1": 0.5}
    table.write_text("left,distance_m\nleft_9.png,0.5\nleft_0.png,0.25\n")
    driven = read_odometry(plot)
    assert driven == {"0": 0.25}
    assert "has no row for left_1.png:" in str(odometry_fault(plot, driven, plot.pairs))
    assert odometry_fault(plot, driven, plot.pairs[:1]) is None
    with pytest.raises(RequestError, match="leave it out"):
        read_odometries([plot], speed=0.05)
    table.write_text("time_s\n1\n3\n")
    assert "--speed" in str(odometry_fault(plot, None, plot.pairs))
    assert read_odometries([plot], speed=0.05)[plot.name] is not None
    assert read_odometry(plot) is None
    assert read_odometry(plot, speed=0.05) == {"0": 0.05, "1": pytest.approx(0.15)}
    for text, part in (
        ("distance_m\n1\nnan\n", "not a number"),
        ("distance_m\nx\n", "not a number"),
        ("metres\n1\n", "needs a column"),
        ("distance_m\n1\n", "1 rows for 2 pairs"),
        ("distance_m\n" + "9" * 200_000 + "\n", "is not a table"),
    ):
        table.write_text(text)
        with pytest.raises(RequestError, match=part):
            read_odometry(plot)


# --- following ---


def sighting(along: float, depth: float = 0.8, **parts) -> Sighting:
    values = dict(diameter_mm=14.0, deviation_mm=0.1, depth_m=depth, along_m=along, confidence=0.8)
    column = 749.5 + 1000.0 * (along + 0.05) / depth
    return Sighting((column - 20, 0, column + 20, 500), (column, column), 0.9, 250.0, column, **{**values, **parts})  # pyright: ignore[reportArgumentType]


def drive(stalks: list[tuple[float, float]], steps: int = 20, scale: float = 1.0, seed: int = 0):
    """Return the sightings of stalks (position along the row, depth), m, and odometry that is wrong by a factor ``scale``."""
    rng = np.random.default_rng(seed)
    places = 0.05 + 0.1 * np.arange(steps)
    frames = []
    for place in places:
        seen = [each for each in stalks if abs(each[0] - place) < 0.6]
        frames.append([sighting(x - place + rng.normal(0, 0.001), depth + rng.normal(0, 0.003)) for x, depth in seen])
    return frames, (places - places[0]) * scale


STALKS = [(0.02, 0.8), (0.045, 0.82), (0.3, 0.79), (0.33, 0.8), (0.7, 0.81), (1.1, 0.8), (1.4, 0.78), (1.96, 0.8)]


@pytest.mark.parametrize("scale", [1.0, 1.03, 0.97])
def test_stalks_are_counted_once_although_odometry_is_wrong(scale):
    frames, distances = drive(STALKS, scale=scale)
    tracks, path = track_stalks(frames, distances, CAMERAS)
    counted = [track for track in tracks if track.counted]
    assert len(counted) == len(STALKS)
    places = np.array([track.position_m for track in counted]) + 0.05
    np.testing.assert_allclose(places, [x for x, _ in STALKS], atol=0.03)
    assert path.length == pytest.approx(2.0, rel=0.02)


def test_a_robot_that_drives_backwards_sees_the_same():
    frames, distances = drive(STALKS)
    tracks, path = track_stalks(frames[::-1], distances[::-1], CAMERAS)
    counted = [track for track in tracks if track.counted]
    assert len(counted) == len(STALKS) and path.length == pytest.approx(2.0, rel=0.02)
    assert counted[0].position_m > counted[-1].position_m


def test_cameras_may_move_to_their_left_while_distances_grow():
    frames, distances = drive(STALKS)
    found = track_either_way(frames[::-1], distances, CAMERAS)
    counted = [track for track in found.tracks if track.counted]
    assert found.is_consistent and len(counted) == len(STALKS) and found.path.length == pytest.approx(2.0, rel=0.02)
    places = [track.position_m for track in counted]
    assert places == sorted(places)
    np.testing.assert_allclose(places, [1.95 - x for x, _ in STALKS[::-1]], atol=0.03)
    # What fits as it is given stays as it is.
    plain = track_stalks(frames, distances, CAMERAS)
    same = track_either_way(frames, distances, CAMERAS)
    assert same.is_consistent and same.tracks == plain[0] and np.array_equal(same.path.positions, plain[1].positions)


@pytest.mark.parametrize("scale", [0.0, 0.5, 2.0, 100.0, -100.0])
def test_odometry_in_another_unit_does_not_fit(scale):
    frames, distances = drive(STALKS)
    assert not track_either_way(frames, scale * distances, CAMERAS).is_consistent


def test_images_that_share_nothing_contradict_nothing():
    """Pairs are 1.3 m apart, and show 1.2 m each."""
    rng = np.random.default_rng(0)
    frames = [[sighting(x) for x in rng.uniform(-0.6, 0.6, 16)] for _ in range(6)]
    assert track_either_way(frames, 1.3 * np.arange(6), CAMERAS).is_consistent
    assert track_either_way([], np.zeros(0), CAMERAS).is_consistent


def test_stalks_that_are_missed_in_some_pairs_stay_one():
    frames, distances = drive(STALKS)
    rng = np.random.default_rng(3)
    frames = [[each for each in frame if rng.random() < 0.7] for frame in frames]
    tracks, _ = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == len(STALKS)


def test_what_few_pairs_show_is_not_a_stalk_and_ends_are_ends():
    frames, distances = drive([*STALKS, (2.3, 0.8)])
    frames[8].append(sighting(0.05))  # a leaf, once
    tracks, _ = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == len(STALKS)
    reasons = " ".join(track.reason for track in tracks)
    assert "seen in 1 of" in reasons and "beyond the ends" in reasons


def test_two_finds_of_one_stalk_are_one_and_neighbours_that_touch_are_two():
    frames, distances = drive([*STALKS, (0.7145, 0.81)])
    assert sum(track.counted for track in track_stalks(frames, distances, CAMERAS)[0]) == len(STALKS) + 1
    for frame in frames:
        again = [dataclasses.replace(each, along_m=each.along_m + 0.003, score=0.6) for each in frame[:3]]  # pyright: ignore
        frame += again
    assert sum(track.counted for track in track_stalks(frames, distances, CAMERAS)[0]) == len(STALKS) + 1


def test_a_sighting_without_disparity_still_says_where_its_stalk_is():
    frames, distances = drive(STALKS)
    for frame in frames:
        for place, each in enumerate(frame):
            if place % 3 == 1:
                frame[place] = dataclasses.replace(each, diameter_mm=None, depth_m=None, along_m=None, reason="unclear")
    tracks, _ = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == len(STALKS)


def test_a_stalk_that_leans_out_of_the_plot_stands_in_it():
    """Its foot counts: measured 40 mm beyond the end at 12 inches, it stands 14 mm inside if it leans outwards."""
    frames, distances = drive([*STALKS, (2.04, 0.8)])
    assert sum(track.counted for track in track_stalks(frames, distances, CAMERAS)[0]) == len(STALKS)
    for lean, more in ((10.0, 1), (-10.0, 0)):
        leaning = [[dataclasses.replace(each, height_m=0.3048, lean_deg=lean) for each in frame] for frame in frames]
        counted = [track for track in track_stalks(leaning, distances, CAMERAS)[0] if track.counted]
        assert any(track.position_m > 1.97 for track in counted) == bool(more)


def test_a_stalk_with_a_wrong_depth_is_not_another_one():
    """In some pairs, its depth is 6 cm too large, but it is seen in the same direction."""
    frames, distances = drive([(0.6, 0.8), (1.4, 0.8)])
    for frame in frames[3:7]:
        each, far = frame[0], 0.86
        frame[0] = dataclasses.replace(each, depth_m=far, along_m=each.column / 1000.0 * far - 0.05)
    tracks, _ = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == 2
    # One that does stand behind is seen beside it as the cameras move on.
    frames, distances = drive([(0.6, 0.8), (1.4, 0.8), (0.6, 0.88)])
    assert sum(track.counted for track in track_stalks(frames, distances, CAMERAS)[0]) == 3


def test_what_stands_before_the_row_or_has_no_place_counts_less():
    frames, distances = drive([*STALKS, (1.0, 0.55)])
    tracks, _ = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == len(STALKS)
    assert any("before the row" in track.reason for track in tracks)
    for count, more in ((5, 0), (9, 1)):  # of the 14 pairs that have it in view
        frames, distances = drive([*STALKS, (0.9, 0.8)])
        for number, frame in enumerate(frames):
            for place in [place for place, each in enumerate(frame) if abs(each.along_m + 0.1 * number - 0.85) < 0.01][::-1]:  # pyright: ignore
                each = frame.pop(place)
                if 4 <= number < 4 + count:
                    frame.append(dataclasses.replace(each, diameter_mm=None, depth_m=None, along_m=None, reason="unclear"))
        assert sum(track.counted for track in track_stalks(frames, distances, CAMERAS)[0]) == len(STALKS) + more


@pytest.mark.parametrize("behind", [1.1, 1.6])
def test_rows_behind_are_not_counted_even_if_more_of_their_stalks_are_in_view(behind):
    others = [(x, behind) for x in np.arange(-0.3, 2.3, 0.08)]
    frames, distances = drive([*STALKS, *others])
    assert np.median([sighting.depth_m for frame in frames for sighting in frame]) == pytest.approx(behind, abs=0.02)
    tracks, path = track_stalks(frames, distances, CAMERAS)
    assert path.row_depth == pytest.approx(0.8, abs=0.01) and sum(track.counted for track in tracks) == len(STALKS)
    for track in tracks:
        assert path.is_behind_row(track) == (track.depth_m > 1.0)
    assert sum(path.is_behind_row(track) for track in tracks) > len(STALKS)


def test_stalks_behind_the_row_are_recognised_where_they_have_no_depth():
    """Stereo gives depths behind the row without positions, and often neither."""
    behind = [(x, 1.6) for x in np.arange(-0.3, 2.3, 0.23)]
    frames, distances = drive([*STALKS, *behind])
    unclear = set()
    for number, frame in enumerate(frames):
        for place, sighting in enumerate(frame):
            if sighting.depth_m > 1.0:  # pyright: ignore
                depth = sighting.depth_m if (number + place) % 3 == 0 else None
                unclear |= set() if depth else {(number, place)}
                frame[place] = dataclasses.replace(sighting, depth_m=depth, along_m=None, diameter_mm=None, reason="unclear")
    tracks, path = track_stalks(frames, distances, CAMERAS)
    assert sum(track.counted for track in tracks) == len(STALKS)
    recognised = {sighting for track in tracks if path.is_behind_row(track) for sighting in track.sightings}
    assert len(unclear & recognised) > 0.8 * len(unclear)


def test_a_sighting_without_depth_belongs_to_the_row_before_a_stalk_behind_that_was_measured_long_ago():
    """In one pair, the stalk at 1.1 m stands 4 mm beside its place, exactly before the place of the one behind."""
    frames, distances = drive([*STALKS, (0.908, 1.6)])
    passing, place, at = 13, 1.35, -1
    for number, frame in enumerate(frames):
        kept = [each for each in frame if each.depth_m < 1.0 or number < 4]  # pyright: ignore[reportOptionalOperand]
        if number == passing:
            at = int(np.argmin([abs(each.along_m + place - 1.1) for each in kept]))  # pyright: ignore[reportOptionalOperand]
            hidden = sighting(1.104 - place)
            kept[at] = dataclasses.replace(hidden, depth_m=None, along_m=None, diameter_mm=None, reason="unclear")
        frames[number] = kept
    tracks, path = track_stalks(frames, distances, CAMERAS)
    (owner,) = [track for track in tracks if (passing, at) in track.sightings]
    assert owner.counted and owner.position_m == pytest.approx(1.05, abs=0.01)
    assert sum(path.is_behind_row(track) for track in tracks) == 1


def test_the_depth_of_the_near_row():
    assert near_row_depth([0.4, 1.6, 0.8, 1.58, 0.82, 1.61, 0.78, 1.6]) == pytest.approx(0.8)  # 0.4: a leaf
    assert near_row_depth([1.2, 1.22, 0.8, 1.21]) == pytest.approx(1.21) and near_row_depth([0.9]) == 0.9


def test_no_pairs_and_empty_fields():
    assert track_stalks([], np.zeros(0), CAMERAS)[0] == []
    tracks, path = track_stalks([[], []], np.array([0.0, 0.1]), CAMERAS)
    assert tracks == [] and path.length == pytest.approx(0.2)


def test_widths_are_medians_with_an_error():
    sightings = [sighting(0.0, diameter_mm=14.0 + each) for each in (-0.2, -0.1, 0.0, 0.1, 0.2)]
    width = robust_width([*sightings, sighting(0.0, diameter_mm=30.0)])
    assert width is not None and width.mm == pytest.approx(14.05, abs=0.06) and 0.03 < width.error < 0.3 and width.count == 6
    assert robust_width([sighting(0.0, diameter_mm=None)]) is None
    one = robust_width(sightings[:1])
    assert one is not None and one.scatter == pytest.approx(0.1)


def test_errors_of_widths_hold_what_pairs_share():
    """If pairs agree exactly, the error is that of the masks' common bias, the calibration, and edges that may be occluded."""

    def error(**parts) -> float:
        width = robust_width([sighting(0.0, diameter_mm=14.0, deviation_mm=0.0, **parts) for _ in range(9)])
        assert width is not None and width.scatter == 0.0
        return width.error

    assert error() == pytest.approx(0.07)
    assert error(width_px=14.0) == pytest.approx(math.hypot(0.7, 0.07))
    assert error(width_px=140.0) < 0.15 * error(width_px=14.0) + 0.07
    assert error(occluded=True) == pytest.approx(math.hypot(1.5, 0.07))


def test_widths_are_those_at_12_and_24_inches():
    """Stalks are measured 2 inches below and above; one is occluded at 24 inches, one shows no ground, one is not measured."""
    taper, inch = 0.3, 0.0254

    def seen(beside: float, **parts) -> Sighting:
        lower, upper = 14.0 - taper * beside, 14.0 - taper * (12 + beside)
        values = dict(diameter_mm=lower, height_m=(12 + beside) * inch, upper_mm=upper, upper_height_m=(24 + beside) * inch)
        return sighting(0.0, **{**values, "upper_deviation_mm": 0.1, "upper_confidence": 0.8, **parts})

    stalks = [[seen(2.0), seen(2.0), seen(2.2)] for _ in range(6)]
    occluded = dict(upper_mm=None, upper_height_m=None)
    stalks += [
        [seen(-2.0, **occluded)] * 3,
        [seen(0.0, height_m=None, **occluded)] * 3,
        [seen(0.0, diameter_mm=None, **occluded)] * 3,
    ]
    tracks = [Track(tuple((stalk, place) for place in range(3)), 0.0, 0.8, True, "") for stalk in range(len(stalks))]
    found = stalk_widths(stalks, tracks)
    first, below, unknown, nothing = found[0], *found[6:]
    assert first.lower.mm == pytest.approx(14.0, abs=0.01) and first.upper.mm == pytest.approx(10.4, abs=0.01)  # pyright: ignore
    assert first.taper == pytest.approx(taper, abs=1e-3) and first.height_known and first.lower.corrected  # pyright: ignore
    # The taper is that of the other stalks, not the usual one; and it makes the error larger.
    assert below.lower.mm == pytest.approx(14.0, abs=0.01) and below.upper is None and below.taper is None  # pyright: ignore
    assert USUAL_TAPER != taper and below.lower.error > 0.1  # pyright: ignore[reportOptionalMemberAccess]
    assert unknown.lower.mm == 14.0 and not unknown.height_known  # pyright: ignore[reportOptionalMemberAccess]
    assert nothing.lower is None


def test_a_stalk_counts_from_where_it_faces_the_camera():
    """Sightings from aside, from where an oval stalk looks thinner, have less weight."""
    stalk = [sighting(0.0, diameter_mm=14.0 - 0.05 * abs(ray), ray_deg=ray) for ray in (-36.0, -24.0, 0.0, 2.0, 24.0, 36.0)]
    alike = [dataclasses.replace(each, ray_deg=None) for each in stalk]
    assert robust_width(stalk).mm > 13.5 > robust_width(alike).mm  # pyright: ignore[reportOptionalMemberAccess]


def test_an_edge_that_another_stalk_hides_is_not_its_own():
    def stalk(column: float, depth: float) -> Measurement:
        return Measurement(14.0, 0.1, row=600.0, column=column, width=40.0, depth=depth, lean=0.1, confidence=0.8)

    # The second stands before the right edge of the first; the third touches nothing, nor does the one that was not measured.
    found = [stalk(100.0, 0.80), stalk(130.0, 0.77), stalk(300.0, 0.80), Measurement(row=600.0)]
    assert _occluded_edges(found) == [True, False, False, False]
    # Of two that stand equally far away, either may hide the other's edge.
    assert _occluded_edges([found[0], dataclasses.replace(found[1], depth=0.799)]) == [True, True]
    assert _occluded_edges([found[0], dataclasses.replace(found[1], depth=0.83)]) == [False, True]


def test_a_sliver_of_a_stalk_is_not_its_width():
    """The width of a stalk with an occluded edge in all pairs is that of the others if it is less than 0.4 of it."""

    def widths(*bounds: float, clear: int = 6) -> list[StalkWidths]:
        hidden = dict(height_m=12 * 0.0254, occluded=True, confidence=0.08)
        stalks = [[sighting(0.0, diameter_mm=18.0 + stalk, height_m=12 * 0.0254)] * 3 for stalk in range(clear)]
        stalks += [[sighting(0.0, diameter_mm=bound, **hidden)] * 3 for bound in bounds]
        tracks = [Track(tuple((stalk, place) for place in range(3)), 0.0, 0.8, True, "") for stalk in range(len(stalks))]
        return stalk_widths(stalks, tracks)[clear:]

    sliver, thin, whole = (width.lower for width in widths(4.0, 9.0, 20.0))
    assert sliver.mm == 20.5 and sliver.error == pytest.approx(1.7, abs=0.1)  # pyright: ignore[reportOptionalMemberAccess]
    assert thin.mm == 9.0 and whole.mm == 20.0  # pyright: ignore[reportOptionalMemberAccess]
    # Four clear stalks are too few to say what is usual in the plot.
    assert widths(4.0, clear=4)[0].lower.mm == 4.0  # pyright: ignore[reportOptionalMemberAccess]


def test_a_stalk_that_is_partly_hidden_is_at_least_as_thick_as_it_looks():
    hidden = dict(occluded=True, confidence=0.08)
    occluded = [sighting(0.0, diameter_mm=each, **hidden) for each in (8.0, 10.0, 12.0, 13.0, 13.8, 14.0)]
    clear = [sighting(0.0, diameter_mm=14.0 + each) for each in (-0.1, 0.0, 0.1)]
    assert robust_width([*occluded, *clear]).mm == pytest.approx(14.0, abs=0.01)  # pyright: ignore[reportOptionalMemberAccess]
    assert robust_width(occluded).mm == pytest.approx(13.7, abs=0.31)  # pyright: ignore[reportOptionalMemberAccess]
    above = [
        dataclasses.replace(
            each,
            upper_mm=each.diameter_mm,
            upper_confidence=0.08,
            upper_occluded=each.occluded,
            occluded=False,
        )
        for each in occluded
    ]
    heights = [dataclasses.replace(each, height_m=12 * 0.0254, upper_height_m=24 * 0.0254) for each in above]
    (found,) = stalk_widths([heights], [Track(tuple((0, place) for place in range(6)), 0.0, 0.8, True, "")])
    assert found.lower.mm < 13.0 < found.upper.mm  # pyright: ignore[reportOptionalMemberAccess]


def test_many_lower_bounds_outweigh_few_diameters_below_them():
    """An edge can be hidden unnoticed, for example by a leaf of the same color."""
    bounds = [sighting(0.0, diameter_mm=each, occluded=True, confidence=0.06) for each in np.linspace(11.6, 12.2, 12)]
    unnoticed = [sighting(0.0, diameter_mm=8.0 + each, confidence=0.3) for each in (-0.1, 0.0, 0.1)]
    assert robust_width([*bounds, *unnoticed]).mm > 11.5  # pyright: ignore[reportOptionalMemberAccess]


@given(
    st.lists(
        st.tuples(st.floats(1.0, 40.0), st.floats(0.05, 1.0), st.booleans()),
        min_size=1,
        max_size=12,
    )
)
def test_the_width_minimises_quantile_losses(values):
    """Compare with the loss at every measurement: the minimum is at one, and the width lies between its neighbours."""
    sightings = [sighting(0.0, diameter_mm=mm, confidence=weight, occluded=hidden) for mm, weight, hidden in values]
    widths, weights, hidden = (np.array(column) for column in zip(*values))
    weights, quantiles = weights * np.where(hidden, 4.0, 1.0), np.where(hidden, 0.85, 0.5)
    candidates = np.unique(widths)
    apart = widths - candidates[:, None]
    losses = (weights * np.where(apart > 0, quantiles * apart, (quantiles - 1.0) * apart)).sum(axis=1)
    best = int(np.argmin(losses))
    low, high = candidates[max(best - 1, 0)], candidates[min(best + 1, len(candidates) - 1)]
    assert low - 1e-6 <= robust_width(sightings).mm <= high + 1e-6  # pyright: ignore[reportOptionalMemberAccess]


# --- evaluation ---


def test_finds_are_matched_as_coco_matches_them():
    clear, occluded = (StalkInView(name, (0, 0, 1, 1), None, share, 9, box, share) for name, share, box in (
        (4, 0.9, (0.0, 0.0, 40.0, 500.0)), (5, 0.1, (100.0, 0.0, 140.0, 500.0))))  # fmt: skip

    def find(left: float, score: float) -> Detection:
        return Detection((left, 0.0, left + 40.0, 500.0), (left, left), score, np.zeros((1, 1)), (0, 0))

    finds = [find(2.0, 0.6), find(1.0, 0.9), find(101.0, 0.8), find(300.0, 0.7)]
    owners, scored = match_detections(finds, [clear, occluded])
    assert owners == [None, 4, 5, None]
    assert sorted(scored) == [(0.6, 0.0), (0.7, 0.0), (0.9, 1.0)]


def test_average_precision_and_the_figures_of_plots():
    assert average_precision(np.array([[0.9, 1], [0.8, 1]]), 2) == 1.0
    assert average_precision(np.array([[0.9, 0], [0.8, 1]]), 1) == pytest.approx(0.5)
    assert average_precision(np.zeros((0, 2)), 3) == 0.0
    scores = [
        PlotScore(
            0,
            30,
            29,
            np.array([[14.0, 13.0], [12.0, 12.5]]),
            np.array([[0.9, 1.0], [0.2, 1.0]]),
            2,
            errors=np.array([0.5, 0.3]),
        ),
        PlotScore(1, 40, 41, np.zeros((0, 2)), np.zeros((0, 2)), 1),
    ]
    figures = summarize_scores(scores)
    assert figures["count_r2"] == pytest.approx(1.0 - 2.0 / 50.0) and figures["count_mae"] == 1.0
    assert figures["width_mae_mm"] == pytest.approx(0.75) and figures["width_bias_mm"] == pytest.approx(0.25)
    assert figures["width_coverage_95"] == 0.5  # 1 mm beside, of 0.98, and 0.5 of 0.59
    assert figures["precision"] == 1.0 and figures["recall"] == pytest.approx(1 / 3)
    # Both finds, of scores .9 and .2, are right; one stalk of three is found by none.
    assert figures["f1_best"] == pytest.approx(0.8) and figures["f1_best_least_score"] == 0.2
    assert np.isnan(summarize_scores([])["f1"])


def test_the_thesis_counts_by_length_and_takes_means():
    frames = [[sighting(0.01 * place) for place in range(count)] for count in (10, 14)]
    # 1500 pixels at f = 1000 and 0.8 m show 1.2 m.
    assert count_by_length(frames, CAMERAS, 2.4) == pytest.approx(24.0)
    assert count_by_length([[], []], CAMERAS, 2.4) == 0.0
    found = mean_widths([[sighting(0.0), sighting(0.1, diameter_mm=None)], [sighting(0.0, diameter_mm=16.0)]], [[3, 4], [3]])
    assert found == {3: 15.0}
