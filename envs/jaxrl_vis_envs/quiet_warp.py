"""Keeps MJX from printing that Warp is missing, which is an option of MJX that nothing here uses.

MJX prints two lines to stdout when its module `mujoco.mjx.warp` is imported: once in a process, whoever imports MJX first. The
package `jaxrl_vis_envs` installs the hook below when it is imported itself, which loads neither MuJoCo nor JAX; it takes those
two lines away, and nothing else that is printed. Where MJX was imported before, nothing is left to do.
"""

import contextlib
import importlib.abc
import importlib.machinery
import io
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

_MODULE = "mujoco.mjx.warp"
_REMARK = "Failed to import "


class _Finder(importlib.abc.MetaPathFinder):
    """Finds `mujoco.mjx.warp` as Python would, with a loader that is quieter."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname != _MODULE:
            return None
        remove()
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def execute_quietly(module: ModuleType) -> None:
                printed = io.StringIO()
                try:
                    with contextlib.redirect_stdout(printed):
                        execute(module)
                finally:
                    kept = [line for line in printed.getvalue().splitlines(True) if not line.startswith(_REMARK)]
                    sys.stdout.write("".join(kept))

            loader.exec_module = execute_quietly
        return spec


_FINDER = _Finder()


def install() -> None:
    """From now on MJX's remark is not printed."""
    if _MODULE not in sys.modules and _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)


def remove() -> None:
    """Undoes `install`."""
    if _FINDER in sys.meta_path:
        sys.meta_path.remove(_FINDER)
