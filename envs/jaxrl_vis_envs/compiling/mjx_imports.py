"""Import hook that makes MJX import faster and hides its notice about Warp.

When `mujoco.mjx.warp` is imported and Warp, an optional backend, is missing, MJX prints two lines. Its mesh module imports
trimesh and `scipy.spatial` for models with colliding meshes, which takes three quarters of the total import time. The hook
removes the two lines and defers these libraries until they are used. `jaxrl_vis_envs.physics` installs it before importing MJX;
it has no effect if MJX is already imported. Other output during the import of `mujoco.mjx.warp` is printed after the import.
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

_NOTICE = "Failed to import "


class _LazyModule(ModuleType):
    """Placeholder for a module, which is imported when an attribute is read."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def _make_trimesh(*arguments: Any, **named: Any) -> Any:
    return importlib.import_module("trimesh").Trimesh(*arguments, **named)


@contextlib.contextmanager
def _defer_mesh_libraries() -> Iterator[None]:
    """Import placeholders instead of trimesh and `scipy.spatial` within the context."""
    deferred = {name: _LazyModule(name) for name in ("trimesh", "scipy.spatial") if name not in sys.modules}
    if "trimesh" in deferred:
        deferred["trimesh"].Trimesh = _make_trimesh  # pyright: ignore[reportAttributeAccessIssue] - MJX annotates with it
    sys.modules.update(deferred)
    try:
        yield
    finally:
        for name in deferred:
            del sys.modules[name]


@contextlib.contextmanager
def _hide_notice() -> Iterator[None]:
    """Remove MJX's notice from the output printed in this context."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            yield
    finally:
        lines = [line for line in printed.getvalue().splitlines(True) if not line.startswith(_NOTICE)]
        with contextlib.suppress(OSError, ValueError):  # stdout cannot be written; without a stdout, `print` does nothing
            print("".join(lines), end="")


_CONTEXTS = {"mujoco.mjx.warp": _hide_notice, "mujoco.mjx._src.mesh": _defer_mesh_libraries}


class _Finder(importlib.abc.MetaPathFinder):
    """Import finder that executes the two modules of MJX in `_CONTEXTS` within their contexts."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname not in _CONTEXTS:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def execute_in_context(module: ModuleType) -> None:
                with _CONTEXTS[fullname]():
                    execute(module)

            loader.exec_module = execute_in_context
        return spec


_FINDER = _Finder()


def install() -> None:
    """Install the hook; further calls have no effect."""
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)
