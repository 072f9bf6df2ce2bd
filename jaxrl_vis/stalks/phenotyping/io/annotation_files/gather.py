"""Collection of all annotations in a folder, in any supported format, with their images."""

import itertools
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.annotation_files import coco, label_studio, labelme, voc, yolo
from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import Annotated, merge_groups
from jaxrl_vis.stalks.phenotyping.io.images import image_size
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis_envs.documents import parse_json, parse_xml, read_bytes, read_json, read_text

_MAX_BYTES = 10_000_000  # of the annotation file of one image
_MAX_DEPTH = 4  # levels of nested folders searched
_MAX_FILES = 200_000
_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}
_HELD_BACK = {"valid", "val", "test", "testing", "validation"}
"""Names of folders of held-out data, skipped if there is a sibling folder ``train``."""
_MALFORMED = (ValueError, KeyError, TypeError, AttributeError, OverflowError, IndexError)
"""Errors raised by a reader given a file in another format."""


def gather(folder: Path) -> list[tuple[Any, Annotated]]:
    """Collect the annotated images of a folder.

    Returns:
        Id and contents of each image. The names of images that exist are paths relative to the folder, missing sizes are read
        from the image files, and polygons of one group are merged (see `merge_groups`).

    Raises:
        RequestError: There are no annotations, a file cannot be read, or an image is ambiguous or annotated twice.
    """
    images = _read(folder)
    index = _Index(folder)
    for _, image in images:
        if isinstance(image.name, str):
            index.resolve_name(image)
        image.annotations = merge_groups(image.annotations)
    return images


def _read(folder: Path) -> list[tuple[Any, Annotated]]:
    path = folder / "annotations.json"
    if path.exists():
        return _convert_errors(path, lambda: _read_coco(path, read_json(path)), "COCO")
    annotated: list[tuple[Any, Annotated]] = []
    others: list[Path] = []
    names: list[str] | None = None
    numbers = itertools.count()
    images = {image.stem: image for image in _walk_files(folder, _IMAGES) if image.is_file()}
    for file in _walk_files(folder, {".json", ".xml", ".txt"}):
        if file.suffix.lower() == ".json":
            read = _read_json(file, numbers)
        elif file.suffix.lower() == ".xml":
            read = _read_xml(file, numbers)
        elif file.stem in images and file.name not in yolo.NAMES:
            names = _class_names(folder) if names is None else names
            read = list(
                zip(
                    numbers,
                    _convert_errors(file, lambda file=file, names=names: _read_yolo(file, images[file.stem], names), "YOLO"),
                )
            )
        else:
            continue
        annotated += read or []
        others += [file] if read is None else []
    broken = next((file for file in others if file.stem in images), None)
    if broken is not None:  # files with other names, such as a calibration, are allowed
        kinds = "Pascal VOC" if broken.suffix.lower() == ".xml" else "LabelMe"
        raise RequestError(f"{broken} is not an annotation of {kinds}, but has the name of an image")
    if not annotated:
        there = f" ({others[0].name} is none)" if others else ""
        raise RequestError(
            f"there are no annotations in {folder}{there}: put annotations.json of COCO there, or .xml of Pascal VOC, .json of "
            "LabelMe or .txt of YOLO beside each image"
        )
    return annotated


def _convert_errors(file: Path, read: Any, format_name: str) -> Any:
    """Call ``read``, converting errors of the readers to a `RequestError`.

    Args:
        file: The file that it reads, for messages.
        read: Reader without arguments.
        format_name: Name of the expected format, for messages.

    Raises:
        RequestError: The file cannot be read, or has another format.
    """
    try:
        return read()
    except RequestError:
        raise
    except OSError as error:
        raise RequestError(f"cannot read {file}: {error.strerror or error}") from error
    except _MALFORMED as error:
        what = "not COCO: it needs images and annotations" if format_name == "COCO" else f"not an annotation of {format_name}"
        raise RequestError(f"{file} is {what}{_error_reason(error)}") from error


def _error_reason(error: Exception) -> str:
    """Return the message of a `ValueError` in parentheses, shortened; empty for other errors."""
    words = " ".join(str(error).split()) if isinstance(error, ValueError) else ""
    return f" ({words[:200]})" if words else ""


def _read_coco(path: Path, data: Any) -> list[tuple[Any, Annotated]]:
    if not coco.is_coco(data):
        raise KeyError("images")
    return coco.read_coco(path, data)


def _read_json(file: Path, numbers: Iterator[int]) -> list[tuple[Any, Annotated]] | None:
    """Read the images of a COCO, LabelMe or Label Studio JSON file; return None if it has another format."""
    data = _convert_errors(file, lambda: parse_json(read_text(file)), "LabelMe")
    if coco.is_coco(data):
        read = _convert_errors(file, lambda: _read_coco(file, data), "COCO")
        # Ids may repeat across files.
        return [((str(file), number) if isinstance(number, (int, str)) else number, image) for number, image in read]
    if label_studio.is_label_studio(data):
        return list(zip(numbers, _convert_errors(file, lambda: label_studio.read_label_studio(file, data), "Label Studio")))
    if labelme.is_labelme(data):
        return list(zip(numbers, _convert_errors(file, lambda: labelme.read_labelme(file, data), "LabelMe")))
    return None


def _read_xml(file: Path, numbers: Iterator[int]) -> list[tuple[Any, Annotated]] | None:
    """Read the images of a Pascal VOC or CVAT XML file; return None if it has another format."""
    root = _convert_errors(file, lambda: parse_xml(read_bytes(file)), "Pascal VOC")
    if root.tag not in ("annotation", "annotations"):
        return None
    return list(zip(numbers, _convert_errors(file, lambda: voc.read_xml(file, root), "Pascal VOC")))


def _read_yolo(file: Path, image: Path, names: list[str]) -> list[Annotated]:
    text = read_text(file, _MAX_BYTES)
    if not yolo.is_yolo(text):
        raise ValueError("its lines are not a class and numbers")
    height, width = image_size(image)
    return [Annotated(image.name, width, height, file, yolo.read_yolo(file, text, names, (width, height)))]


def _class_names(folder: Path) -> list[str]:
    """Read the names of the YOLO classes from the first file in `yolo.NAMES` that exists; empty if there is none."""
    for name in yolo.NAMES:
        for path in (folder / name, folder.parent / name, *sorted(folder.glob(f"*/{name}"))):
            if path.is_file():
                return _convert_errors(path, lambda path=path: yolo.read_names(path), "YOLO's classes")
    return []


def _walk_files(folder: Path, suffixes: set[str]) -> Iterator[Path]:
    """Yield the files with some suffixes in a folder and up to three levels of subfolders, sorted by name within each.

    Folders of held-out data, hidden files and folders, folders called ``truth`` and unreadable folders are skipped.

    Raises:
        RequestError: There are more than 200,000.
    """
    count, waiting = 0, [(folder, 0)]
    while waiting:
        here, depth = waiting.pop(0)
        try:
            inside = sorted(path for path in here.iterdir() if not path.name.startswith("."))
        except OSError:
            continue
        folders = [path for path in inside if path.is_dir() and path.name != "truth"]
        if any(path.name.lower() == "train" for path in folders):
            folders = [path for path in folders if path.name.lower() not in _HELD_BACK]
        for path in inside:
            if path.suffix.lower() in suffixes and not path.is_dir():
                count += 1
                if count > _MAX_FILES:
                    raise RequestError(f"{folder} holds more than {_MAX_FILES} files: name the folder of the annotations")
                yield path
        waiting += [(path, depth + 1) for path in folders if depth + 1 < _MAX_DEPTH]


class _Index:
    """Index of the images in a folder by lower-case file name, with and without suffix."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._by_name: dict[str, list[Path]] = {}
        self._taken: dict[Path, Path] = {}
        for path in filter(Path.is_file, _walk_files(folder, _IMAGES)):
            self._by_name.setdefault(path.name.lower(), []).append(path)
            self._by_name.setdefault(path.stem.lower() + "\0", []).append(path)

    def resolve_name(self, image: Annotated) -> None:
        """Set ``image.name`` to the path of its file relative to the folder, and its width and height if they are missing.

        Modifies ``image`` in place; it is unchanged if no such file exists.

        Raises:
            RequestError: Several files match, the file is annotated elsewhere, too, or its size cannot be read.
        """
        path = self._locate(image.name, image.source)
        if path is None:
            return
        other = self._taken.setdefault(path, image.source)
        if other != image.source:
            raise RequestError(f"{path.name} is annotated twice, in {other} and in {image.source}: keep one of them")
        image.name = readable(path.relative_to(self._folder).as_posix()) if path.name == readable(path.name) else image.name
        if not image.width or not image.height:
            try:
                image.height, image.width = image_size(path)
            except OSError as error:
                raise RequestError(f"the annotations in {self._folder} name an image that cannot be read: {error}") from error

    def _locate(self, name: str, source: Path) -> Path | None:
        parts = PureWindowsPath(name).parts
        base = parts[-1] if parts else ""
        neighbours = [
            path for path in (source.parent.joinpath(*parts), self._folder.joinpath(*parts)) if parts and ".." not in parts
        ]
        for path in neighbours:
            if path.suffix.lower() in _IMAGES and path in self._by_name.get(base.lower(), []):
                return path
        stem = Path(base).stem if Path(base).suffix.lower() in _IMAGES else base
        candidates = self._by_name.get(base.lower()) or self._by_name.get(f"{stem.lower()}\0", [])
        near = [path for path in candidates if path.parent == source.parent] or candidates
        exact = [path for path in near if path.name == base] or near
        if len(exact) > 1:
            both = " or ".join(readable(str(path.relative_to(self._folder))) for path in exact[:2])
            raise RequestError(f"{source} is of {readable(name)[:80]}, which may be {both}: rename or remove one of them")
        return exact[0] if exact else None
