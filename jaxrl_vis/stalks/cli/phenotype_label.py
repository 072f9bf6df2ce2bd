"""``jaxrl-vis phenotype label``: propose annotations."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import check_extra


@dataclasses.dataclass(frozen=True, kw_only=True)
class Label:
    """Propose boxes and outlines of stalks in your own images, to correct in CVAT, LabelMe or Label Studio and to train on."""

    images: Annotated[Path, AlsoPositional()]
    """Folder of images. Annotations are written beside them; existing ones are never overwritten."""
    format: Literal["coco", "labelme"] = "coco"
    """Format of the annotations: one annotations.json in COCO format, for import in CVAT (`COCO 1.0`) and Label Studio, or a
    LabelMe .json beside each image."""
    weights: Path | None = None
    """Weights from `phenotype train`; the shipped ones if not given."""
    min_score: float = 0.3
    """Minimum score of a proposal, 0 to 1; low, as deleting a false one is quicker than drawing a missing one."""


def label(options: Label) -> int:
    """Write the proposals, and return the exit status: 3 if images were skipped, 0 otherwise.

    Raises:
        RequestError: An option, the folder or the file of weights is invalid, there are annotations in COCO format already, a
            package is missing, or no device works.
    """
    if not 0.0 <= options.min_score <= 1.0:
        raise RequestError(f"--min-score must be from 0 to 1, not {options.min_score:g}")
    check_extra("phenotyping")
    from jaxrl_vis.stalks.phenotyping.io.folders import image_files
    from jaxrl_vis.stalks.phenotyping.report.proposals import write_coco, write_labelme

    if not options.images.is_dir():
        raise RequestError(f"{options.images} is not a folder: name the folder of the images")
    check_writable(options.images, "IMAGES", folder=True)
    there = options.images / "annotations.json"
    if options.format == "coco" and there.exists():
        raise RequestError(f"{there} is there already: move it away, so that no annotation is lost")
    paths = image_files(options.images)
    if not paths:
        raise RequestError(f"there are no images in {options.images}: name a folder of PNG, JPEG, TIFF, BMP, PGM or PPM")
    if options.format == "labelme":
        annotated = [path for path in paths if path.with_suffix(".json").exists()]
        paths = [path for path in paths if path not in annotated]
        if annotated:
            print(f"annotated already, so left alone: {len(annotated)} images")
    print(f"{options.images}: {len(paths)} images; loading the networks ...", flush=True)
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.stalks.phenotyping.detector.loading import detector_name, load_finder, resolve_weights
    from jaxrl_vis.stalks.phenotyping.io.images import read_image, to_rgb8

    weights = resolve_weights(options.weights)
    find = load_finder(weights, options.min_score)
    labelled, skipped = [], 0
    for index, path in enumerate(paths, start=1):
        try:
            image = to_rgb8(read_image(path))
        except OSError as error:
            print(f"skipped {error}", flush=True)
            skipped += 1
            continue
        detections = find(image)
        labelled.append((path, (image.shape[0], image.shape[1]), detections))
        if options.format == "labelme":
            write_labelme(path, (image.shape[0], image.shape[1]), detections)
        print(f"{index} of {len(paths)}  {path.name}: {len(detections)} proposals", flush=True)
    if options.format == "coco":
        write_coco(there, labelled, f"proposals of {detector_name(weights)}: correct them")
    total = sum(len(detections) for _, _, detections in labelled)
    where = there if options.format == "coco" else f"{options.images}/*.json"
    print(f"{where}: {total} proposals in {len(labelled)} images; correct them, then `jaxrl-vis phenotype train`")
    return 3 if skipped else 0
