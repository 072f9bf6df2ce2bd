"""Spares the import of MJX what nothing here needs: two lines on stdout, and libraries for meshes.

MJX prints that Warp is missing, which is an option of MJX that nothing here uses, when its module `mujoco.mjx.warp` is
imported. And its module of meshes imports trimesh and `scipy.spatial`, which takes three quarters of the time of the whole
import, for models in which meshes collide. The package `jaxrl_vis_envs` installs the hook below when it is imported itself,
which loads neither MuJoCo nor JAX: it takes those two lines away, and nothing else that is printed, and lets those libraries
wait until they are used. Where MJX was imported before, nothing is left to do. What is printed while Warp is looked for comes
out afterwards.
"""

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import io
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

_REMARK = "Failed to import "


class _Later(ModuleType):
    """Stands for a module that is imported when something of it is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def _make_trimesh(*arguments: Any, **named: Any) -> Any:
    return importlib.import_module("trimesh").Trimesh(*arguments, **named)


@contextlib.contextmanager
def _without_mesh_libraries() -> Iterator[None]:
    """What is imported inside gets modules that wait; everybody else gets the modules themselves."""
    waiting = {name: _Later(name) for name in ("trimesh", "scipy.spatial") if name not in sys.modules}
    if "trimesh" in waiting:
        waiting["trimesh"].Trimesh = _make_trimesh  # pyright: ignore[reportAttributeAccessIssue] - MJX annotates with it
    sys.modules.update(waiting)
    try:
        yield
    finally:
        for name in waiting:
            del sys.modules[name]


@contextlib.contextmanager
def _without_remark() -> Iterator[None]:
    """What is printed inside, less MJX's remark."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            yield
    finally:
        kept = [line for line in printed.getvalue().splitlines(True) if not line.startswith(_REMARK)]
        with contextlib.suppress(OSError, ValueError):  # nobody can read it; where there is no stdout, `print` does nothing
            print("".join(kept), end="")


_DURING = {"mujoco.mjx.warp": _without_remark, "mujoco.mjx._src.mesh": _without_mesh_libraries}


class _Finder(importlib.abc.MetaPathFinder):
    """Finds modules of MJX as Python would, with loaders that do without."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname not in _DURING:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def execute_without(module: ModuleType) -> None:
                with _DURING[fullname]():
                    execute(module)

            loader.exec_module = execute_without
        return spec


_FINDER = _Finder()


def install() -> None:
    """From now on MJX is imported without."""
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)
