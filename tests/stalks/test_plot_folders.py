"""Tests of folders of images and odometry as written by cameras and robots: pairing of images, and distances driven."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odometry_of_plot import read_odometry

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, Patterns, PlotFolder, find_plots
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image
from jaxrl_vis.stalks.phenotyping.io.naming.stamps import match_nearest, parse_timestamp
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import odometry_fault


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def pairs(folder: Path, patterns: Patterns | None = None) -> dict[str, list[tuple[str | None, str | None]]]:
    return {
        plot.name: [
            (pair.left and pair.left.relative_to(folder).as_posix(), pair.right and pair.right.relative_to(folder).as_posix())
            for pair in plot.pairs
        ]
        for plot in find_plots(folder, patterns)
    }


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("cam0/000.png", "cam1/000.png"),
        ("camera_1/000.png", "camera_2/000.png"),
        ("image_00/data/000.png", "image_01/data/000.png"),
        ("image_2/000.png", "image_3/000.png"),
        ("infra1/000.png", "infra2/000.png"),
        ("LEFT_CAM/0.png", "RIGHT_CAM/0.png"),
        ("left_images/0.png", "right_images/0.png"),
        ("im0.png", "im1.png"),
        ("cam0_000.jpg", "cam1_000.jpg"),
        ("infra1_000.png", "infra2_000.png"),
        ("aloeL.png", "aloeR.png"),
        ("left01.jpg", "right01.jpg"),
        ("left_000.bmp", "right_000.bmp"),
        ("left_000.pgm", "right_000.ppm"),
        ("left/1608946479.473160.png", "right/1608946479.473190.png"),
        ("left/1608946479473160331.png", "right/1608946479473960331.png"),
        ("cam0/1403636579763555584.png", "cam1/1403636579763555999.png"),
        ("left_1608946479_473160331.png", "right_1608946479_473960331.png"),
    ],
)
def test_images_of_both_sides_are_a_pair(tmp_path, left, right):
    folder = touch(tmp_path / "plot", left, right)
    assert pairs(folder) == {"plot": [(left, right)]}


@pytest.mark.parametrize(
    "names",
    [
        ["im0.png", "im1.png", "im2.png"],  # images of one camera
        ["image_0.png", "image_1.png"],
        ["frame0.png", "frame1.png"],
        ["rowL.png", "rowA.png"],
        ["cam0/000.png", "cam2/000.png"],
    ],
)
def test_images_of_one_camera_are_no_pairs(tmp_path, names):
    with pytest.raises(RequestError, match="holds no stereo pairs"):
        find_plots(touch(tmp_path, *names))


@pytest.mark.parametrize(
    ("names", "part"),
    [
        ([f"image_0{number}/data/0.png" for number in range(4)], "holds pairs of image_00 and image_01 and of"),
        (["cam0/0.png", "cam1/0.png", "cam2/0.png"], "say which with --left"),
        (["left_raw_0.png", "left_rect_0.png", "right_raw_0.png", "right_rect_0.png"], "raw images (raw_0) and rectified ones"),
        ([f"{side}/1608946479.{cents}.png" for side, cents in (("left", 10), ("left", 20), ("right", 14), ("right", 24))],
         "40 ms apart"),
    ],
)  # fmt: skip
def test_where_names_do_not_say_it_the_user_is_asked(tmp_path, names, part):
    with pytest.raises(RequestError) as error:
        find_plots(touch(tmp_path, *names))
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1


def test_images_that_show_both_sides_are_reported(tmp_path):
    cv2.imwrite(str(tmp_path / "IMG_0001.png"), np.zeros((20, 60), np.uint8))
    with pytest.raises(RequestError, match="IMG_0001.png is 60 x 20: if it shows both sides, cut it"):
        find_plots(tmp_path)


def test_plots_in_nested_folders_have_the_way_to_them_as_name(tmp_path):
    plots = [f"field 1/range{row}/plot{plot}" for row in (1, 2) for plot in (1, 2)]
    touch(tmp_path, *(f"{plot}/{side}_0.png" for plot in plots for side in ("left", "right")))
    touch(tmp_path, "field 1/notes.txt", ".hidden/left_0.png", ".hidden/right_0.png")
    assert list(pairs(tmp_path)) == plots


def test_patterns_name_images_of_each_plot(tmp_path):
    for plot in ("a", "b"):
        touch(tmp_path, *(f"{plot}/image_0{camera}/{frame}.png" for camera in range(4) for frame in ("000", "001")))
    colour = Patterns("image_02/*.png", "image_03/*.png")
    assert pairs(tmp_path, colour) == {
        plot: [(f"{plot}/image_02/{frame}.png", f"{plot}/image_03/{frame}.png") for frame in ("000", "001")]
        for plot in ("a", "b")
    }
    assert list(pairs(tmp_path / "a", colour)) == ["a"]
    touch(tmp_path / "c", "x1/f_l-0007.png", "x1/f_r-0007.png", "x2/f_l-0007.png", "x2/f_l-0008.png", "x2/.f_l-0009.png")
    (plot,) = find_plots(tmp_path / "c", Patterns("**/f_l-????.png", "**/f_r-????.png"))
    assert [pair.name for pair in plot.pairs] == ["x1_0_0_0_7", "x2_0_0_0_7", "x2_0_0_0_8"]
    assert [pair.right is not None for pair in plot.pairs] == [True, False, False]
    for pattern in ("/etc/*.png", "../*.png", "", "C:\\x\\*.png"):
        with pytest.raises(RequestError, match="patterns within each plot's folder"):
            find_plots(tmp_path, Patterns(pattern, "b/*.png"))
    with pytest.raises(RequestError, match="holds no images for --left 'none/.*.png' and --right"):
        find_plots(tmp_path, Patterns("none/*.png", "b/*.png"))


def test_patterns_and_terms_are_checked_before_anything_is_computed(tmp_path, capsys):
    touch(tmp_path, "left_0.png", "right_0.png")
    for words, told in (
        (["--left", "a*.png"], "--left and --right go together"),
        (["--term", "stalks"], "--term takes COLUMN=TERM"),
        (["--field", str(tmp_path / "none.csv")], "cannot read"),
    ):
        assert cli.main(["phenotype", "run", str(tmp_path), "--out", str(tmp_path / "out"), *words]) == 2
        assert told in capsys.readouterr().err


def test_sizes_of_bitmaps_are_read_before_they_are_decoded(tmp_path):
    image = np.arange(240, dtype=np.uint8).reshape(12, 20)
    for name, pixels in (
        ("a.bmp", np.dstack([image] * 3)),
        ("a.pgm", image),
        ("a.pgm", image * np.uint16(200)),
        ("a.ppm", np.dstack([image] * 3)),
    ):
        cv2.imwrite(str(tmp_path / name), pixels)
        assert image_size(tmp_path / name) == (12, 20)
        np.testing.assert_array_equal(read_image(tmp_path / name), pixels)
    (tmp_path / "a.pgm").write_bytes(b"P5\n# made\n99999 99999\n255\n" + bytes(240))
    with pytest.raises(OSError, match="million"):
        read_image(tmp_path / "a.pgm")


# --- times ---
@given(st.lists(st.integers(1, 400), min_size=1, max_size=8), st.integers(-3, 3), st.sampled_from([1, 1000, 1_000_000]))
def test_images_are_paired_by_the_nearest_times(gaps, shift, unit):
    """Whatever the intervals, a small common shift leaves every image with its own partner."""
    left = {str(place): sum(gaps[: place + 1]) * 0.01 for place in range(len(gaps))}
    right = {f"r{name}": time + shift * 1e-9 * unit for name, time in left.items()}
    assert match_nearest(left, right) == {name: f"r{name}" for name in left}
    assert match_nearest(left, {}) == {}


@pytest.mark.parametrize(
    ("stem", "seconds"),
    [
        ("1608946479.473160", 1608946479.473160),
        ("left_1608946479473160331", 1608946479.473160331),
        ("frame-1608946479473", 1608946479.473),
        ("1608946479_473160331", 1608946479.473160331),
        ("000123", None),
        ("20240611", None),
        ("plot_12.5", None),
    ],
)
def test_times_in_names(stem, seconds):
    assert parse_timestamp(stem) == (None if seconds is None else pytest.approx(seconds, abs=1e-6))


# --- odometry ---
NAMES = ("left0000.jpg", "left0001.jpg", "left0002.jpg")


def plot(folder: Path, names: tuple[str, ...] = NAMES) -> PlotFolder:
    return PlotFolder("plot", folder, tuple(PairFiles(Path(name).stem, folder / name, None) for name in names))


def ros1(x: float, y: float, second: int) -> str:
    stamp = f'header: \n  seq: 1\n  stamp: \n    secs: {second}\n    nsecs: 500000000\n  frame_id: "odom"\n'
    pose = f"pose: \n  pose: \n    position: \n      x: {x}\n      y: {y}\n      z: 0.0\n    orientation: \n      x: 0.0\n"
    return stamp + pose + "---\n"


def ros2(x: float, y: float, second: int) -> str:
    return ros1(x, y, second).replace("secs: ", "sec: ", 1).replace("nsecs", "nanosec").replace(": \n", ":\n")


def echo_p() -> str:
    head = "%time,field.header.seq,field.header.stamp,field.pose.pose.position.x,field.pose.pose.position.y\n"
    return head + "".join(f"{1608946479 + row}500000000,1,1,{5 + 0.12 * row},{1 + 0.16 * row}\n" for row in range(3))


DEGREES = np.degrees(0.2 / 6_371_000.0)


def rows(head: str, line: str) -> str:
    """Return a table with a row for each image, formatted by ``line`` from its name, stem, number and position."""
    values = [
        {"name": name, "stem": name[:-4], "upper": name.upper(), "row": row, "x": 0.12 * row, "y": 0.16 * row}
        for row, name in enumerate(NAMES)
    ]
    return head + "".join(
        line.format(**value, north=f"{40.1 + value['row'] * DEGREES:.9f}", two=2 * value["row"]) for value in values
    )


TABLES = {
    "semicolons and commas": ("odometry.csv", rows("left;distance_m\n", "{name};0,{two}\n")),
    "tabs": ("odometry.tsv", rows("left\tdistance_m\n", "{name}\t0.{two}\n")),
    "spaces": ("odometry.txt", rows("left distance_m\n", "{name} 0.{two}\n")),
    "capitals, millimetres": ("odometry.csv", rows("Left,Distance (mm)\n", "{name},{two}00\n")),
    "centimetres": ("odometry.csv", rows("image,dist_cm\n", "{name},{two}0\n")),
    "a comment, blank lines, empty cells": ("odometry.csv", "# robot 2\n\ndistance_m,\n0,\n\n0.2,\n,\n0.4,\n ,\n"),
    "paths of Windows": ("odometry.csv", rows("left,distance_m\n", "C:\\d\\{name},0.{two}\n")),
    "stems": ("odometry.csv", rows("left,distance_m\n", "{stem},0.{two}\n")),
    "capitals of names": ("odometry.csv", rows("left,distance_m\n", "{upper},0.{two}\n")),
    "positions": ("odometry.csv", rows("left,x,y\n", "{name},{x},-{y}\n")),
    "a trajectory of TUM": ("odometry.txt", rows("# timestamp tx ty tz qx qy qz qw\n", "{row} {x} -{y} 0 0 0 0 1\n")),
    "GPS": ("gps.csv", rows("left,latitude,longitude\n", "{name},{north},-88.2\n")),
    "rostopic echo": ("odometry.txt", "".join(ros1(0.12 * row, 0.16 * row, row) for row in range(3))),
    "ros2 topic echo": ("odometry.yaml", "".join(ros2(-0.12 * row, 0.16 * row, row) for row in range(3))),
    "rostopic echo -p": ("odom.csv", echo_p()),
    "rostopic echo of GPS": (
        "gps.txt",
        rows(
            "", "header: \n  stamp: \n    secs: {row}\n    nsecs: 0\nlatitude: {north}\nlongitude: -88.2\naltitude: 7.0\n---\n"
        ),
    ),
}


@pytest.mark.parametrize("table", TABLES)
def test_odometry_in_every_form(tmp_path, table):
    name, text = TABLES[table]
    (tmp_path / name).write_text(text)
    driven = read_odometry(plot(tmp_path))
    assert driven is not None and driven.keys() == {Path(name).stem for name in NAMES}
    np.testing.assert_allclose(list(driven.values()), [0.0, 0.2, 0.4], atol=2e-4)
    assert odometry_fault(plot(tmp_path), driven, plot(tmp_path).pairs) is None


def test_odometry_of_a_spreadsheet_in_utf16(tmp_path):
    (tmp_path / "odometry.csv").write_text("left\tdistance_m\nleft0001.jpg\t0,2\n", encoding="utf-16")
    assert read_odometry(plot(tmp_path)) == {"left0001": 0.2}


def test_images_are_placed_between_rows_by_their_times(tmp_path):
    names = ("1608946480.000000.png", "1608946481.250000.png", "1608946999.000000.png")
    (tmp_path / "odometry.txt").write_text("".join(ros1(0.3 * row, 0.4 * row, 1608946479 + row) for row in range(4)))
    driven = read_odometry(plot(tmp_path, names))
    assert driven is not None and set(driven) == {Path(name).stem for name in names[:2]}
    np.testing.assert_allclose(list(driven.values()), [0.25, 0.875], atol=1e-6)
    said = odometry_fault(plot(tmp_path, names), driven, plot(tmp_path, names).pairs)
    assert said is not None and names[2] in said


def test_times_in_nanoseconds_keep_their_differences(tmp_path):
    rows = "".join(f"{name},{1608946479473159936 + row * 10**8}\n" for row, name in enumerate(NAMES))
    (tmp_path / "odometry.csv").write_text("left,time_ns\n" + rows)
    driven = read_odometry(plot(tmp_path), 0.5)
    assert driven is not None
    np.testing.assert_allclose(list(driven.values()), [0.0, 0.05, 0.1], atol=1e-6)


@pytest.mark.parametrize("number", ["1_0", "nan", "inf", "1e400", "", "x"])
def test_cells_that_are_not_numbers_are_reported_with_their_line(tmp_path, number):
    (tmp_path / "odometry.csv").write_text(f"left,distance_m\nleft0000.jpg,0\n\nleft0001.jpg,{number}\n")
    if number == "1_0":
        assert read_odometry(plot(tmp_path)) == {"left0000": 0.0, "left0001": 10.0}
        return
    with pytest.raises(RequestError, match="not a number in line 4"):
        read_odometry(plot(tmp_path))
