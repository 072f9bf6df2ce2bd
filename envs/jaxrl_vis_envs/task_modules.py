"""Tasks from outside this package: user modules and entry points of installed packages. Imports neither JAX nor MuJoCo.

my_task:MyReach     the environment MyReach of the module my_task, in the current folder or on Python's path
MyReach             provided by an installed package, as an entry point of the group `GROUP`:

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
"""Entry point group for the tasks of installed packages."""
_MAX_MESSAGE = 400  # characters of a user's error; JAX's errors in traced code repeat themselves for pages


class TaskModuleError(ValueError):
    """Error for a task's module that is missing or cannot be imported. Its message is one line with the problem and a hint."""


def is_custom(name: str) -> bool:
    """Return True if a task's name includes its module."""
    return ":" in name


def split(name: str) -> tuple[str, str]:
    """Split ``module:Name`` into module and Name.

    Raises:
        TaskModuleError: The name does not have this form.
    """
    module, _, task = name.partition(":")
    if "/" in module or "\\" in module or module.endswith(".py"):
        parts = module.removesuffix(".py").replace("\\", "/").split("/")
        dotted = ".".join(part for part in parts if part not in ("", ".", ".."))
        raise TaskModuleError(
            f"{name!r} names a file, not a module: write {dotted}:{task or 'Name'}, in the folder that it is relative to"
        )
    if not all(part.isidentifier() for part in (*module.split("."), task)):
        raise TaskModuleError(f"{name!r} is not a task: a task of your own is written module:Name, such as my_task:MyReach")
    return module, task


def entry_points() -> dict[str, list[importlib.metadata.EntryPoint]]:
    """Return the tasks of installed packages, by name; usually one entry point each. Nothing is imported."""
    points: dict[str, list[importlib.metadata.EntryPoint]] = {}
    for point in importlib.metadata.entry_points(group=GROUP):
        if point not in points.setdefault(point.name, []):
            points[point.name].append(point)
    return points


def load(module: str, folder: str | None = None, installed: bool = False) -> ModuleType:
    """Import a module of tasks from ``folder``, else from the current folder, else from Python's path.

    The folder that contains the module is added to Python's path, for later imports by the module.

    Args:
        module: Name of the module, dotted if it is in a package.
        folder: Folder from which it was imported earlier; it may no longer exist. None if unknown.
        installed: Search only Python's path.

    Returns:
        The module, imported already if it was loaded before.

    Raises:
        TaskModuleError: The module is missing or cannot be imported, or another one of the same name is already loaded.
    """
    folders = [] if installed else [Path(candidate).resolve() for candidate in (folder, ".") if candidate is not None]
    source = next((candidate for candidate in folders if _file_in(candidate, module) is not None), None)
    file = None if source is None else _file_in(source, module)
    if module not in sys.modules:
        _import(module, source, file, folder)
    loaded = sys.modules[module]
    if file is not None and _origin(loaded) != file:
        raise TaskModuleError(
            f"{file} cannot be imported: Python has loaded another {module} already ({_origin(loaded) or 'built in'}); "
            "rename yours, or start a new process"
        )
    return loaded


def find(module: str, folder: str | None = None) -> Path | None:
    """Return the file that `load` would import first, without importing anything; None if there is none.

    Args:
        module: Name of the module, dotted if it is in a package. For a module in an installed package, the result is the file
            of the package.
        folder: Folder from which it was imported earlier; it may no longer exist. None if unknown.
    """
    for candidate in (folder, "."):
        if candidate is not None and (file := _file_in(Path(candidate).resolve(), module)) is not None:
            return file
    spec = importlib.machinery.PathFinder.find_spec(module.partition(".")[0])
    if spec is None:
        return None
    # A namespace package has folders but no file.
    paths = [spec.origin] if spec.origin is not None else spec.submodule_search_locations or []
    return next((Path(path).resolve() for path in paths), None)


def import_root(module: ModuleType) -> str | None:
    """Return the folder that must be on Python's path to import a module again; None if it is installed or has no file."""
    file = _origin(module)
    if file is None or {"site-packages", "dist-packages"} & set(file.parts):
        return None
    depth = module.__name__.count(".") + (file.name == "__init__.py")
    return str(file.parents[depth])


def describe_error(error: BaseException, file: str | None) -> str:
    """Describe an error in user code in one line: its type, its message, and the line of ``file``, if any, that caused it."""
    if isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error.msg} ({Path(error.filename or '?').name}, line {error.lineno})"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    where = f" ({Path(file).name}, line {lines[-1]})" if file and lines else ""
    message = " ".join(str(error).split()) or "no message"
    if len(message) > _MAX_MESSAGE:
        message = message[:_MAX_MESSAGE].rstrip() + " ..."
    return f"{type(error).__name__}: {message}{where}"


def _import(module: str, source: Path | None, file: Path | None, folder: str | None) -> None:
    before = list(sys.path)
    if source is not None and str(source) not in sys.path:
        sys.path.insert(0, str(source))
    importlib.invalidate_caches()  # a notebook may have written the file a moment ago
    try:
        importlib.import_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - user code may raise anything
        sys.path[:] = before
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if source is None and missing and f"{module}.".startswith(f"{missing}."):
            raise TaskModuleError(_not_found(module, folder)) from error
        install = f"; install {missing.partition('.')[0]}" if missing else ""
        raise TaskModuleError(f"{module} cannot be imported: {describe_error(error, file and str(file))}{install}") from error


def _not_found(module: str, folder: str | None) -> str:
    if folder is not None and Path(folder).resolve() != Path.cwd():
        return (
            f"{module} was imported from {folder}, which no longer contains it; neither does the current folder: "
            "run this in the folder that does"
        )
    names = [path.stem for path in sorted(Path.cwd().glob("*.py"))]
    near = nearest(module, names, "run this in the folder that contains it")
    return f"there is no module {module}, in {Path.cwd()} or installed{near}"


def _file_in(folder: Path, module: str) -> Path | None:
    """Return the file that ``module`` has if ``folder`` is on Python's path; None if the folder does not contain it."""
    path = folder.joinpath(*module.split("."))
    return next((file for file in (path / "__init__.py", path.with_name(f"{path.name}.py")) if file.is_file()), None)


def _origin(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file).resolve()
