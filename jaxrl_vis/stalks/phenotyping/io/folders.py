"""Discovery of plots and pairing of stereo images by file name.

left_000.png  right_000.png          or  any names with left and right, or L and R, as a separate word
left/000.png  right/000.png          or  the same names in two folders, also L and R, cam0 and cam1, image_02 and image_03, ...
disparity_000.pfm, disparity/000.png optional: disparities of the left images, used instead of our own

Names that are timestamps may differ between the sides: each image is paired with the nearest one.
"""

import dataclasses
import re
from pathlib import Path, PureWindowsPath

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.images import image_size
from jaxrl_vis.stalks.phenotyping.io.names import check_length, readable
from jaxrl_vis.stalks.phenotyping.io.naming.sides import partner_names
from jaxrl_vis.stalks.phenotyping.io.naming.stamps import match_nearest, parse_timestamp

_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}
SAMPLE = Path(__file__).parents[1] / "sample_row"
"""Folder of a short synthetic row of plants that ships with the package."""
_MAX_DEPTH = 6  # levels of nested folders searched for plots
_MAX_FOLDERS = 20_000
_MAX_DELAY = 0.005  # s, maximum median delay between the images of a pair: a robot at 0.3 m/s drives 1.5 mm
_DISPARITIES = {".pfm", ".png", ".tif", ".tiff"}
_WORD = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)
_LETTER = re.compile(r"(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


@dataclasses.dataclass(frozen=True)
class PairFiles:
    """Files of one stereo pair.

    Attributes:
        name: Name of the pair, usable as a file name.
        left, right: The images; None if missing.
        disparity: Precomputed disparities of the left image, used instead of stereo matching; None if there are none.
    """

    name: str
    left: Path | None
    right: Path | None
    disparity: Path | None = None


@dataclasses.dataclass(frozen=True)
class PlotFolder:
    """Folder of one plot.

    Attributes:
        name: Name of the plot: that of its folder, or its path relative to the folder that was searched.
        folder: Path of the folder.
        pairs: Pairs in natural order of their names.
    """

    name: str
    folder: Path
    pairs: tuple[PairFiles, ...]


@dataclasses.dataclass(frozen=True)
class Patterns:
    """Glob patterns of the left and right images within the folder of a plot, such as ``image_02/*.png``.

    Attributes:
        left, right: Glob patterns; the wildcards match the same text in both images of a pair.
    """

    left: str
    right: str


def find_plots(folder: Path, patterns: Patterns | None = None) -> list[PlotFolder]:
    """Find the plots in a folder: the folder itself if it holds pairs, else all subfolders that do, named by relative path.

    Args:
        folder: The folder.
        patterns: Patterns of the images' names; None to recognise the sides by name.

    Raises:
        RequestError: There is no such folder, it holds no pairs, a pattern is invalid, or files or plot names are ambiguous.
    """
    if not folder.is_dir():
        raise RequestError(f"there is no folder {folder}: name one with stereo pairs")
    for pattern in () if patterns is None else (patterns.left, patterns.right):
        if not pattern or PureWindowsPath(pattern).anchor or ".." in PureWindowsPath(pattern).parts:
            raise RequestError(f"--left and --right are patterns within each plot's folder, as 'left/*.png', not {pattern!r}")
    own = _find_pairs(folder, patterns)
    folders = {folder: own} if own else _search_subfolders(folder, patterns)
    plots: dict[str, PlotFolder] = {}
    for path, pairs in folders.items():
        check_length(path)
        relative = path.resolve().name if own else path.relative_to(folder).as_posix()
        name = "/".join(readable(part) for part in relative.split("/")) or "plot"
        if name in plots:
            raise RequestError(f"{readable(str(folder))} holds two plots called {name}: rename one of them")
        plots[name] = PlotFolder(name, path, pairs)
    if not plots:
        raise RequestError(_no_pairs_message(folder, patterns))
    return list(plots.values())


def _search_subfolders(folder: Path, patterns: Patterns | None) -> dict[Path, tuple[PairFiles, ...]]:
    """Return the pairs of all subfolders that hold some, up to `_MAX_DEPTH` levels deep; folders inside those are not searched.

    Raises:
        RequestError: There are more than 20,000 folders.
    """
    plots: dict[Path, tuple[PairFiles, ...]] = {}
    waiting, count = [(path, 1) for path in _subfolders(folder)], 0
    while waiting:
        path, depth = waiting.pop(0)
        count += 1
        if count > _MAX_FOLDERS:
            raise RequestError(f"{readable(str(folder))} holds more than {_MAX_FOLDERS} folders: name one with plots")
        pairs = _find_pairs(path, patterns)
        if pairs:
            plots[path] = pairs
        elif depth < _MAX_DEPTH:
            waiting = [(inside, depth + 1) for inside in _subfolders(path)] + waiting
    return plots


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _no_pairs_message(folder: Path, patterns: Patterns | None) -> str:
    """Return the message that a folder holds no pairs, with a hint at the likely reason."""
    if patterns is not None:
        return f"{folder} holds no images for --left {patterns.left!r} and --right {patterns.right!r}, nor do folders in it"
    for path in image_files(folder)[:1]:
        try:
            height, width = image_size(path)
        except OSError:
            break
        if width >= 1.95 * height:
            return (
                f"{folder} holds no stereo pairs, but {readable(path.name)} is {width} x {height}: if it shows both sides, "
                "cut it into left_000.png and right_000.png"
            )
    return (
        f"{folder} holds no stereo pairs: name images left_000.png and right_000.png, put them into left/ and right/, or say "
        "--left 'PATTERN' --right 'PATTERN'"
    )


_Sides = dict[str, dict[str, Path]]
"""Files by name of their pair and role: left, right or disparity."""


def _find_pairs(folder: Path, patterns: Patterns | None) -> tuple[PairFiles, ...]:
    if patterns is not None:
        sides = _pair_by_patterns(folder, patterns)
    else:
        sides = _pair_by_folder(folder) or {}
        for name, files in _pair_by_name(folder).items():
            for side, path in files.items():
                _add_pair(sides, name, side, path)
        _check_rectified(folder, sides)
    sides = _pair_by_times(folder, sides)
    stored = _find_folder(folder, ("disparity",))
    inside = [] if stored is None else image_files(stored, _DISPARITIES)
    for path in [*inside, *image_files(folder, _DISPARITIES)]:
        is_sibling = path.parent == folder
        stem = readable(path.stem)
        name = re.sub("disparity", "", stem, flags=re.IGNORECASE).strip("_-. ") if is_sibling else stem
        if name in sides and (not is_sibling or "disparity" in stem.lower()):
            _add_pair(sides, name, "disparity", path)
    files = [
        PairFiles(name, by_side.get("left"), by_side.get("right"), by_side.get("disparity")) for name, by_side in sides.items()
    ]
    return tuple(sorted(files, key=lambda pair: _natural_sort_key(pair.name)))


def _add_pair(sides: _Sides, name: str, side: str, path: Path) -> None:
    """Add a file to ``sides``, in place.

    Raises:
        RequestError: The pair has another file in this role, or the name is too long.
    """
    check_length(path)
    other = sides.setdefault(name, {}).setdefault(side, path)
    if other != path:
        both = " and ".join(readable(str(file)) for file in (other, path))
        what = "disparity" if side == "disparity" else f"{side} image"
        raise RequestError(f"{both} are both the {what} of pair {name}: rename one of them, or move it elsewhere")


def _pair_by_patterns(folder: Path, patterns: Patterns) -> _Sides:
    """Find the images that match two patterns; the text matched by the wildcards is the name of the pair."""
    sides: _Sides = {}
    for side, pattern in (("left", patterns.left), ("right", patterns.right)):
        stars = _compile_pattern(pattern)
        for path in sorted(folder.glob(pattern)):
            match = stars.fullmatch(path.relative_to(folder).as_posix())
            if path.is_file() and not path.name.startswith(".") and match is not None:
                name = "_".join(part.replace("/", "_").strip("_") for part in match.groups() if part) or "pair"
                _add_pair(sides, readable(name), side, path)
    return sides if any("left" in files for files in sides.values()) else {}


def _compile_pattern(pattern: str) -> re.Pattern[str]:
    """Compile a glob pattern to a regular expression with a group for each wildcard."""
    parts = {"**/": r"((?:.*/)?)", "*": r"([^/]*)", "?": r"([^/])"}
    words = re.split(r"(\*\*/|\*|\?|\[[^\]]*\])", pattern)
    return re.compile("".join(parts.get(word) or (f"({word})" if word.startswith("[") else re.escape(word)) for word in words))


def _check_rectified(folder: Path, sides: _Sides) -> None:
    """Raise a `RequestError` if some images are named raw and others rectified."""
    kinds = {kind: [name for name in sides if kind in re.split(r"[^a-z]+", name.lower())] for kind in ("raw", "rect")}
    if all(kinds.values()):
        raise RequestError(
            f"{readable(str(folder))} holds raw images ({kinds['raw'][0]}) and rectified ones ({kinds['rect'][0]}): name the "
            "rectified ones, as --left '*left*rect*' --right '*right*rect*'"
        )


def _pair_by_times(folder: Path, sides: _Sides) -> _Sides:
    """Pair the images that have no partner of the same name by the timestamps in their names.

    Args:
        folder: The folder, for messages.
        sides: Files by name of their pair; modified in place if all unpaired names are timestamps, unchanged otherwise.

    Returns:
        ``sides``.

    Raises:
        RequestError: The images of a pair are so far apart in time that the robot has moved.
    """
    alone = {side: [name for name, files in sides.items() if set(files) == {side}] for side in ("left", "right")}
    times = {side: {name: parse_timestamp(sides[name][side].stem) for name in names} for side, names in alone.items()}
    if not all(times.values()) or any(time is None for by_name in times.values() for time in by_name.values()):
        return sides
    left, right = ({name: time or 0.0 for name, time in times[side].items()} for side in ("left", "right"))
    partner = match_nearest(left, right)
    apart = sorted(abs(left[name] - right[other]) for name, other in partner.items())
    if apart and apart[len(apart) // 2] > _MAX_DELAY:
        raise RequestError(
            f"{readable(str(folder))}: left and right images are {1000 * apart[len(apart) // 2]:.0f} ms apart by their names, "
            "in which a robot moves on: cameras of a pair must take their images at the same time"
        )
    for name, other in partner.items():
        sides[name] = {**sides[name], **sides.pop(other)}
    return sides


def _pair_by_folder(folder: Path) -> _Sides:
    """Find images in two subfolders, one per side; empty if there are none.

    Raises:
        RequestError: There are several pairs of such folders.
    """
    nested = {path: _side_images(path) for path in _subfolders(folder)}
    names = {path.name.lower(): path for path, images in nested.items() if images}
    pairs = [tuple(names[name] for name in both) for both in (("left", "right"), ("l", "r")) if set(both) <= set(names)][:1]
    if not pairs:
        candidates = {
            (path, names[other.lower()]) if side == "left" else (names[other.lower()], path)
            for path in names.values()
            for side, other in partner_names(path.name)
            if other.lower() in names
        }
        # A folder that holds whole pairs is a plot, not a side.
        pairs = sorted(pair for pair in candidates if not any(_has_pairs(path) for path in pair))
    if len(pairs) > 1:
        both = " and of ".join(f"{readable(left.name)} and {readable(right.name)}" for left, right in pairs[:2])
        raise RequestError(f"{readable(str(folder))} holds pairs of {both}: say which with --left 'PATTERN' --right 'PATTERN'")
    sides: _Sides = {}
    for side, path in zip(("left", "right"), pairs[0] if pairs else ()):
        # A folder L that holds whole pairs is a plot of that name, not a side.
        if _has_pairs(path):
            return {}
        for image in nested[path]:
            _add_pair(sides, readable(image.stem), side, image)
    return sides


def _side_images(folder: Path) -> list[Path]:
    """Return the images of one camera: those in a folder, or in its subfolder ``data`` as in KITTI."""
    images, inside = image_files(folder), folder / "data"
    return images or (image_files(inside) if inside.is_dir() else [])


def _has_pairs(folder: Path) -> bool:
    return any(len(by_side) == 2 for by_side in _pair_by_name(folder).values())


def _pair_by_name(folder: Path) -> _Sides:
    """Find images whose names indicate their side, by a word, a letter or a camera number."""
    images = {path: readable(path.stem) for path in image_files(folder)}
    images = {path: stem for path, stem in images.items() if "disparity" not in stem.lower()}
    stems = {stem.lower() for stem in images.values()}
    sides: _Sides = {}
    for image, stem in images.items():
        word = _match_side(stem, stems)
        if word is not None:
            name = (stem[: word.start()] + stem[word.end() :]).strip("_-. ") or "pair"
            _add_pair(sides, name, "left" if word.group().lower().startswith("l") else "right", image)
        else:
            for side, other in _pair_by_counter(stem, stems):
                # The characters common to both names, without the number or letter of the side.
                same = "".join(one for one, two in zip(stem, other) if one == two)
                _add_pair(sides, same.strip("_-. ") or "pair", side, image)
    return sides


def _pair_by_counter(stem: str, stems: set[str]) -> list[tuple[str, str]]:
    """Return the side given by a last letter or camera number of an image's name, with the partner's name; empty if ambiguous.

    im0 and im1 are a pair, but im0 to im7 are the images of one camera.

    Args:
        stem: Stem of the image's name.
        stems: Lower-case stems of all images in its folder.

    Returns:
        At most one side (left or right) and stem of the partner.
    """
    matches = [(side, other) for side, other in partner_names(stem, files=True) if other.lower() in stems]
    if len(matches) != 1:
        return []
    back = [other for _, other in partner_names(matches[0][1], files=True) if other.lower() in stems]
    return matches if len(back) == 1 else []


def _match_side(stem: str, stems: set[str]) -> re.Match[str] | None:
    """Find the word or letter of an image's name that indicates its side; None if there is none.

    Names of field rows and repetitions may hold such letters, too, as in R2_left_000 or plot_R1_L_000. So words take precedence
    over letters, matches whose exchange gives the name of another image over those that do not, and later matches over earlier
    ones, as names usually begin with the plot.

    Args:
        stem: Stem of the image's name.
        stems: Lower-case stems of all images in its folder.
    """
    words = list(_WORD.finditer(stem)) or list(_LETTER.finditer(stem))
    paired = [
        word for word in words if (stem[: word.start()] + _OTHER[word.group().lower()] + stem[word.end() :]).lower() in stems
    ]
    return (paired or words or [None])[-1]


def _find_folder(folder: Path, names: tuple[str, ...]) -> Path | None:
    """Return the subfolder with one of ``names`` (lower case, in order of preference), in any case; None if there is none."""
    folders = [path for path in sorted(folder.iterdir()) if path.name.lower() in names and path.is_dir()]
    return min(folders, key=lambda path: names.index(path.name.lower()), default=None)


def image_files(folder: Path, suffixes: set[str] = _IMAGES) -> list[Path]:
    """Return the images of a folder, or its files with the given suffixes, sorted by name; hidden files are skipped."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    return [path for path in paths if not path.name.startswith(".")]  # macOS leaves a file ._NAME beside each image


def _natural_sort_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key for natural sorting: 2 before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
