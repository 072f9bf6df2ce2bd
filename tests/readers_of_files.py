"""Readers of each kind of file from outside for `readers_worker`, with checks of their values, and their errors."""

import csv
import io
import json
import math
from pathlib import Path

import numpy as np
from readers_worker import Reader

from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs import documents

ANNOTATED = (48, 64)
"""Height and width of annotated images."""
IMAGE = (12, 20)
PAIRS = ("000", "001", "002")


def _only(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def _parses(parse):
    def past(folder: Path) -> bool:
        try:
            parse(sorted(folder.rglob("*.*"))[0])
        except Exception:
            return False
        return True

    return past


def read_calibration(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration

    files = list(folder.iterdir())
    found = read_calibration(files[0] if len(files) == 1 else folder)
    numbers = [found.focal, *found.centre, found.baseline, found.offset]
    assert all(math.isfinite(each) for each in numbers) and found.focal > 0 and 0.008 <= found.baseline <= 2.0
    assert type(found.width) is int and 1 <= found.width <= 100_000 and 1 <= found.height <= 100_000


def read_cameras(folder: Path) -> None:
    """Read two cameras, rectified or not, from the calibration of any program, and check that numbers are finite."""
    from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import UnrectifiedPair
    from jaxrl_vis.stalks.phenotyping.io.calibrations.recognize import read_cameras

    files = list(folder.iterdir())
    found = read_cameras(files[0] if len(files) == 1 else folder)
    arrays = (
        (found.matrices, found.distortions, found.rotation) if isinstance(found, UnrectifiedPair) else (found.left, found.right)
    )
    assert all(np.isfinite(array).all() for array in arrays)
    assert found.size is None or all(type(side) is int and 1 <= side <= 100_000 for side in found.size)


def _recognized(path: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.calibrations import kitti, middlebury, ros, zed

    text = documents.read_text(path, 2_000_000)
    known = (middlebury.is_middlebury, kitti.is_kitti, zed.is_settings, ros.parse_printed, ros.parse_csv, ros.parse_ini)
    if not any(recognize(text) for recognize in known):
        _storage(path)


def read_plan(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.tables.field_plan import read_field_plan

    columns, plan = read_field_plan(_only(folder), [f"plot_{name}" for name in PAIRS])
    assert plan and all(set(values) == set(columns) for values in plan.values())


def _plan(path: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.tables.cells import read_table_text, split_cells

    assert split_cells(path, read_table_text(path, 1_000_000))[1]


def read_any_annotations(folder: Path) -> None:
    """Read annotations beside an image of their size, and check them."""
    import cv2

    (folder / "a.png").write_bytes(cv2.imencode(".png", np.full(ANNOTATED, 90, np.uint8))[1].tobytes())
    read_annotations(folder)


def _any_annotations(path: Path) -> None:
    data = path.read_bytes()
    if path.suffix == ".txt":
        assert [float(word) for word in data.decode().split()]
    else:
        (documents.parse_xml if path.suffix == ".xml" else documents.parse_json)(data)


def _storage(path: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.file_storage import parse_storage

    parse_storage(documents.read_text(path, 2_000_000))


def read_annotations(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
    from jaxrl_vis.stalks.phenotyping.training.annotated import _annotated_mask, _annotated_stalk

    data = read_annotations(folder)
    sizes = {each["id"]: (each["height"], each["width"]) for each in data["images"]}
    for each in data["images"]:
        assert (folder / each["file_name"]).resolve().is_relative_to(folder.resolve())
    for each in data["annotations"]:
        height, width = sizes[each["image_id"]]
        left, top, wide, tall = each["bbox"]
        assert wide > 0 and tall > 0 and left < width and top < height and left + wide > 0 and top + tall > 0
        if (height, width) == ANNOTATED:  # others are compared with their image, and refused
            mask = _annotated_mask(each, (height, width))
            assert mask.shape == ANNOTATED and mask.dtype == bool
            assert np.isfinite(_annotated_stalk(each, (height, width))).all()


def read_odometry(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
    from jaxrl_vis.stalks.phenotyping.io.tables.odometry import read_odometries

    pairs = tuple(PairFiles(name, folder / f"left_{name}.png", folder / f"right_{name}.png") for name in PAIRS)
    plot = PlotFolder("plot", folder, pairs)
    try:
        driven = read_odometries([plot], 0.3)["plot"]
    except RequestError as error:
        if "--speed goes with" not in str(error):
            raise
        driven = read_odometries([plot], None)["plot"]
    assert driven is None or (driven.keys() <= set(PAIRS) and all(map(math.isfinite, driven.values())))


def _table(path: Path) -> None:
    head = next(csv.reader(io.StringIO(path.read_bytes().decode("utf-8-sig"), newline="")))
    assert {"distance_m", "time_s", "left", "x", "latitude"} & set(head)


def read_image(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles
    from jaxrl_vis.stalks.phenotyping.io.images import to_rgb8
    from jaxrl_vis.stalks.phenotyping.io.pair_reading import UnusablePairError, read_pair, read_side
    from jaxrl_vis_envs.plants import Calibration

    sides = sorted(folder.iterdir())
    pair = PairFiles("a", sides[0], sides[-1] if sides[-1].stat().st_size else None)
    try:
        left, right = read_pair(pair, Calibration(IMAGE[1], IMAGE[0], 20.0, (10.0, 6.0), 0.1))
    except UnusablePairError as error:
        if "black" not in str(error):
            raise
        left = right = read_side(pair, "left")
    assert left.shape == right.shape == (*IMAGE, 3) and left.dtype == np.uint8 and (to_rgb8(left) == left).all()


def read_names(folder: Path) -> None:
    """Find the plots in a folder of empty files, and check that no file and no name is used twice."""
    from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
    from jaxrl_vis.stalks.phenotyping.io.tables.odometry import read_odometries

    plots = find_plots(folder)
    pairs = [(plot, pair) for plot in plots for pair in plot.pairs]
    files = [path for _, pair in pairs for path in (pair.left, pair.right, pair.disparity) if path is not None]
    assert files and len(set(files)) == len(files) and all(path.is_file() for path in files)
    assert len({(plot.name, pair.name) for plot, pair in pairs}) == len(pairs)
    for plot, pair in pairs:
        assert (plot.name + pair.name).encode() and len(f"{plot.name}{pair.name}".splitlines()) == 1
    assert read_odometries(plots, None).keys() == {plot.name for plot in plots}


def read_disparity(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles
    from jaxrl_vis.stalks.phenotyping.io.pair_reading import read_known_disparity

    found = read_known_disparity(PairFiles("a", None, None, _only(folder)), np.zeros((*IMAGE, 3), np.uint8), 64.0)
    assert found is not None and found.shape == IMAGE and found.dtype == np.float32
    assert (np.isnan(found) | ((found > 0) & np.isfinite(found))).all()


def _has_size(path: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.io.images import image_size

    image_size(path)


def read_detector(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.detector.weights import read_weights

    params, settings, _ = read_weights(_only(folder))
    assert params.keys() == {"detector", "segmenter"} and len(settings.channels) == 4


def read_painter(folder: Path) -> None:
    from jaxrl_vis.stalks.grasping.masks.painter import read_weights

    params, settings, _ = read_weights(_only(folder))
    assert params.keys() == {"params"} and settings.loss in ("gan", "segmentation")


def _safetensors(path: Path) -> None:
    import safetensors

    with safetensors.safe_open(path, framework="numpy") as file:
        file.metadata()


def read_family(folder: Path) -> None:
    from jaxrl_vis_envs.plants import Family, read

    found = read(_only(folder))
    assert isinstance(found, Family) and isinstance(found.name, str) and found.name


def _document(path: Path) -> None:
    text = documents.read_text(path, 100_000)
    (documents.parse_toml if path.suffix == ".toml" else documents.parse_json)(text)


def read_evaluation(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.report.figures import read_evaluation

    read_evaluation(_only(folder))


def read_truth(folder: Path) -> None:
    from jaxrl_vis.stalks.phenotyping.evaluation.truth_on_disk import _stalks_by_pair, find_truth
    from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder

    _stalks_by_pair.cache_clear()
    image = np.zeros((*ANNOTATED, 3), np.uint8)
    for each in find_truth(image, None, None, PlotFolder("plot", folder, ()), PairFiles("0", None, None)):
        assert each.mask.dtype == bool and np.isfinite(each.box).all()


def read_records(folder: Path) -> None:
    """Check that a record of `phenotype run` that counts as current holds valid sightings; others would be computed again."""
    from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles
    from jaxrl_vis.stalks.phenotyping.pipeline import _is_complete, _sources
    from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
    from jaxrl_vis.stalks.results_folder import is_current

    path = _only(folder)
    if is_current(path, _sources(PairFiles("0", None, None), None), _is_complete):
        record = json.loads(path.read_bytes())
        assert all(len(Sighting.read(each).box) == 4 for each in record["sightings"])


def read_model(folder: Path) -> None:
    import mujoco

    from jaxrl_vis_envs.render import Scene

    path, mark = _only(folder), folder.parent / "loading"
    mark.touch()
    try:
        model = mujoco.MjModel.from_xml_string(path.read_text())
        mujoco.mj_forward(model, mujoco.MjData(model))
    except Exception:
        return
    finally:
        mark.unlink(missing_ok=True)
    for camera in (None, *range(min(model.ncam, 2))):
        scene = Scene.from_mjmodel(model, camera, 8, 8)
        assert scene.height == scene.width == 8


def _loads(path: Path) -> None:
    import mujoco

    mark = path.parent.parent / "loading"
    mark.touch()
    mujoco.MjModel.from_xml_string(path.read_text())
    mark.unlink()


def _pair_errors() -> tuple[type[Exception], ...]:
    from jaxrl_vis.stalks.phenotyping.io.pair_reading import UnusablePairError

    return (UnusablePairError,)


_REQUEST = (RequestError,)
READERS = {
    "calibration": Reader(read_calibration, _parses(_storage), _REQUEST),
    "cameras": Reader(read_cameras, _parses(_recognized), _REQUEST),
    "plan": Reader(read_plan, _parses(_plan), _REQUEST),
    "annotations": Reader(read_any_annotations, _parses(_any_annotations), _REQUEST),
    "coco": Reader(read_annotations, _parses(documents.read_json), _REQUEST),
    "voc": Reader(read_annotations, _parses(lambda path: documents.parse_xml(path.read_bytes())), _REQUEST),
    "labelme": Reader(read_annotations, _parses(documents.read_json), _REQUEST),
    "odometry": Reader(read_odometry, _parses(_table), _REQUEST),
    "image": Reader(read_image, _parses(_has_size), _pair_errors()),
    "names": Reader(read_names, lambda folder: True, _REQUEST),
    "disparity": Reader(read_disparity, _parses(_has_size), _pair_errors()),
    "detector": Reader(read_detector, _parses(_safetensors), _REQUEST),
    "painter": Reader(read_painter, _parses(_safetensors), _REQUEST),
    "family": Reader(read_family, _parses(_document), (ValueError,)),
    "evaluation": Reader(read_evaluation, _parses(documents.read_json), _REQUEST),
    "truth": Reader(read_truth, _parses(documents.read_json), _REQUEST),
    "record": Reader(read_records, _parses(documents.read_json), ()),
    "model": Reader(read_model, _parses(_loads), (ValueError,)),
}
"""Readers by kind of file."""
