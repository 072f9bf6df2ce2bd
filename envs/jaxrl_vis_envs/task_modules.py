"""Tasks of other people: modules that hold them, and the entry points of installed packages. Loads neither JAX nor MuJoCo.

my_task:MyReach     the environment MyReach of the module my_task, from the current folder or wherever Python finds it
MyReach             as a package calls it that is installed, in its entry points of the group `GROUP`:

    [project.entry-points."jaxrl_vis.environments"]
    MyReach = "my_package.tasks:MyReach"
"""

import importlib
import importlib.machinery
import importlib.metadata
import sys
import traceback
from pathlib import Path
from types import ModuleType

from jaxrl_vis_envs.names import nearest

GROUP = "jaxrl_vis.environments"
"""The group of entry points by which an installed package offers tasks."""


class TaskModuleError(ValueError):
    """A module that is to hold a task is not there or cannot be imported. One line: what is wrong, and the mend."""


def is_own(name: str) -> bool:
    """Whether the name of a task says which module holds it."""
    return ":" in name


def split(name: str) -> tuple[str, str]:
    """``module:Name`` -> module, Name.

    Raises:
        TaskModuleError: It is not written so.
    """
    module, _, task = name.partition(":")
    if "/" in module or "\\" in module or module.endswith(".py"):
        parts = module.removesuffix(".py").replace("\\", "/").split("/")
        dotted = ".".join(part for part in parts if part not in ("", ".", ".."))
        raise TaskModuleError(
            f"{name!r} names a file, not a module: write {dotted}:{task or 'Name'}, in the folder it starts from"
        )
    if not all(part.isidentifier() for part in (*module.split("."), task)):
        raise TaskModuleError(f"{name!r} is no task: a task of your own is written module:Name, such as my_task:MyReach")
    return module, task


def entry_points() -> dict[str, list[importlib.metadata.EntryPoint]]:
    """The tasks of installed packages: name -> who offers it, usually one. Nothing is imported."""
    found: dict[str, list[importlib.metadata.EntryPoint]] = {}
    for point in importlib.metadata.entry_points(group=GROUP):
        if point not in found.setdefault(point.name, []):
            found[point.name].append(point)
    return found


def load(module: str, folder: str | None = None, installed: bool = False) -> ModuleType:
    """Imports a module that holds tasks: from ``folder``, or else the current folder, or else as Python finds it.

    The folder that holds it stays on Python's path, for what the module imports later.

    Args:
        module: Its name, with dots where it lies in a package.
        folder: Where it was found before; may have gone.
        installed: Look nowhere but where Python does.

    Raises:
        TaskModuleError: It is not there, it cannot be imported, or another one of the same name is loaded already.
    """
    places = [] if installed else [Path(place).resolve() for place in (folder, ".") if place is not None]
    found = next((place for place in places if _file_in(place, module) is not None), None)
    file = None if found is None else _file_in(found, module)
    if module not in sys.modules:
        _import(module, found, file, folder)
    loaded = sys.modules[module]
    if file is not None and _origin(loaded) != file:
        raise TaskModuleError(
            f"{file} cannot be imported: Python has loaded another {module} already ({_origin(loaded) or 'built in'}); "
            "rename yours, or start another process"
        )
    return loaded


def find(module: str, folder: str | None = None) -> Path | None:
    """The file that `load` would import first, without importing anything; None where there is none.

    Args:
        module: Its name, with dots where it lies in a package: of one that is installed, the package's file is found.
        folder: Where it was found before; may have gone.
    """
    for place in (folder, "."):
        if place is not None and (file := _file_in(Path(place).resolve(), module)) is not None:
            return file
    spec = importlib.machinery.PathFinder.find_spec(module.partition(".")[0])
    if spec is None:
        return None
    places = [spec.origin] if spec.origin is not None else spec.submodule_search_locations or []  # without a file of its own
    return next((Path(place).resolve() for place in places), None)


def folder_of(module: ModuleType) -> str | None:
    """The folder that has to be on Python's path for a module to be found again; None where it is installed, or has no file."""
    file = _origin(module)
    if file is None or {"site-packages", "dist-packages"} & set(file.parts):
        return None
    depth = module.__name__.count(".") + (file.name == "__init__.py")
    return str(file.parents[depth])


def blame(error: BaseException, file: str | None) -> str:
    """An error in a module of somebody's own, in one line: its kind, what it says, and the line of ``file`` that led to it."""
    if isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error.msg} ({Path(error.filename or '?').name}, line {error.lineno})"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    where = f" ({Path(file).name}, line {lines[-1]})" if file and lines else ""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}{where}"


def _import(module: str, found: Path | None, file: Path | None, folder: str | None) -> None:
    before = list(sys.path)
    if found is not None and str(found) not in sys.path:
        sys.path.insert(0, str(found))
    importlib.invalidate_caches()  # a notebook may have written the file a moment ago
    try:
        importlib.import_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - somebody else's code may raise anything
        sys.path[:] = before
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if found is None and missing and f"{module}.".startswith(f"{missing}."):
            raise TaskModuleError(_not_found(module, folder)) from error
        install = f"; install {missing.partition('.')[0]}" if missing else ""
        raise TaskModuleError(f"{module} cannot be imported: {blame(error, file and str(file))}{install}") from error


def _not_found(module: str, folder: str | None) -> str:
    if folder is not None and Path(folder).resolve() != Path.cwd():
        return (
            f"{module} was imported from {folder}, which holds it no longer, and the current folder does not either: "
            "run this in the folder that does"
        )
    names = [path.stem for path in sorted(Path.cwd().glob("*.py"))]
    near = nearest(module, names, "run this in the folder that holds it")
    return f"there is no module {module}, in {Path.cwd()} or installed{near}"


def _file_in(place: Path, module: str) -> Path | None:
    """The file of a module in a folder that would be on Python's path."""
    path = place.joinpath(*module.split("."))
    return next((file for file in (path / "__init__.py", path.with_name(f"{path.name}.py")) if file.is_file()), None)


def _origin(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file).resolve()
