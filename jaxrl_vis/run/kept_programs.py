"""Programs as they were traced, kept on disk, so that a run that has been traced once starts without tracing.

XLA's cache spares compiling a program again. Tracing it, which is Python, goes before that, and takes seconds. What is kept is
StableHLO (`jax.export`), next to XLA's cache: reading it runs no code.

A kept program is that of one fingerprint: the code of both packages, the versions of the libraries, the configuration, JAX's
settings and the device. It does not see what a process has replaced in its own modules (a patched loss, say). So only
commands keep programs, not scripts and notebooks, and none of environments from elsewhere. ``JAXRL_VIS_KEEP_PROGRAMS=0`` turns
it off.

Whoever writes a kept program decides what a run computes. So folder and files are kept for the user alone, nothing is read that
another user has written or could have written, and a file's digest is of its name, too.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import itertools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax import export
from jax.extend.core import jaxpr_as_fun

import jaxrl_vis_envs
from jaxrl_vis.config import Config
from jaxrl_vis.files import make_private, read_private, replacing, stranger_to
from jaxrl_vis.provenance import device_record, versions
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compiling.compilation import target_platform, tracing_for_default_device, use_gpu_kernels

VARIABLE = "JAXRL_VIS_KEEP_PROGRAMS"
MOST_FILES = 300
"""The oldest of more are deleted; one has half a megabyte."""

HOST_FIELDS = ("env_steps", "eval_interval", "checkpoint_interval", "full_checkpoint_interval")
"""Fields of `Config` that say what the host does with a run: nothing that is compiled knows of them."""

_PACKAGES = ("jaxrl_vis", "jaxrl_vis_envs")
_DIGEST_BYTES = 32
# Triton's programs may mean something else to another jaxlib, of which JAX warns; a fingerprint has its version.
_CHECKS = (export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton"),)
# These say what JAX writes down and where, and change no program. Folders may differ from run to run.
_WITHOUT_EFFECT = ("cache", "log", "dump", "dir", "timeout", "traceback")


def fingerprint(config: Config, env: GoalEnv) -> str | None:
    """What the programs of a run depend on, hexadecimal; None if they are not to be kept."""
    is_ours = type(env).__module__.partition(".")[0] in _PACKAGES
    if not is_ours or os.environ.get(VARIABLE) == "0":
        return None
    settings = {name: value for name, value in jax.config.values.items() if not any(part in name for part in _WITHOUT_EFFECT)}
    with tracing_for_default_device():
        target = [target_platform(), use_gpu_kernels()]
    # The seed is an argument, in the form of keys.
    compiled_in = {name: value for name, value in dataclasses.asdict(config).items() if name not in (*HOST_FIELDS, "seed")}
    depends_on = [compiled_in, versions(), device_record(), target, settings, _code()]
    return hashlib.sha256(json.dumps(depends_on, sort_keys=True, default=repr).encode()).hexdigest()


@functools.cache
def _code() -> str:
    """A digest of all files of both packages, models and data included."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        spec = importlib.util.find_spec(package)
        assert spec is not None and spec.origin is not None
        folder = Path(spec.origin).parent
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts):
            contents = path.read_bytes()
            digest.update(f"{package}/{path.relative_to(folder).as_posix()} {len(contents)}\n".encode() + contents)
    return digest.hexdigest()


class CompiledOfLeaves:
    """A compiled program that takes and returns leaves, called with trees.

    Args:
        compiled: From ``jax.jit(...).lower(...).compile()``; takes a list of leaves for each argument. Asked for anything else,
            this is it.
        restore: What its results are, given what it returns.
    """

    def __init__(self, compiled: Any, restore: Callable[[Any], Any]):
        self._compiled, self._restore = compiled, restore

    def __call__(self, *arguments: Any) -> Any:
        """What the program returns for these trees."""
        return self._restore(self._compiled(*map(jax.tree.leaves, arguments)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._compiled, name)


class KeptPrograms:
    """The programs of one fingerprint.

    Args:
        folder: Where programs are kept; it need not be there.
        fingerprint: Theirs.
    """

    def __init__(self, folder: Path, fingerprint: str):
        self._folder, self._fingerprint = folder, fingerprint
        self._fresh: dict[str, bytes] = {}

    def lower(self, name: str, function: Any, arguments: tuple, simplify: Callable[[Any], Any], **jit_options: Any) -> Any:
        """``function.lower`` of a kept program that takes and returns leaves; traced now, where there is none.

        Args:
            name: Of the program.
            function: Jitted.
            arguments: Shapes of what it takes.
            simplify: Makes arrays, lists, tuples and dictionaries of what it returns.
            **jit_options: As of `jaxrl_vis_envs.jit`.
        """
        leaves = tuple(map(jax.tree.leaves, arguments))
        data = self._read(name)
        if data is None:
            traced = function.trace(*arguments)
            call, tree = jaxpr_as_fun(traced.jaxpr), jax.tree.structure(traced.out_info)
            of_leaves = jax.jit(lambda *leaves: simplify(jax.tree.unflatten(tree, call(*itertools.chain(*leaves)))))
            exported = export.export(of_leaves, platforms=(target_platform(),), disabled_checks=_CHECKS)(*leaves)
            self._fresh[name] = data = bytes(exported.serialize())
        # Also what has just been traced: XLA's cache takes a program that was read for another one than that which was traced.
        program = export.deserialize(bytearray(data))
        return jaxrl_vis_envs.jit(program.call, **jit_options).lower(*leaves)

    def write(self) -> None:
        """Keeps what was traced; call it when it has been compiled. Where that cannot be written, nothing is kept."""
        with contextlib.suppress(OSError):
            make_private(self._folder)
            for name, data in self._fresh.items() if self._is_private() else ():
                with replacing(self._path(name), durable=False, mode=0o600) as file:
                    file.write(self._digest(name, data) + data)
            for path in sorted(self._folder.iterdir(), key=lambda path: path.stat().st_mtime)[:-MOST_FILES]:
                path.unlink(missing_ok=True)
        self._fresh.clear()

    def forget(self) -> None:
        """Deletes the programs of this fingerprint."""
        self._fresh.clear()
        with contextlib.suppress(OSError):
            for path in self._folder.glob(f"*-{self._fingerprint}.stablehlo"):
                path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}-{self._fingerprint}.stablehlo"

    def _read(self, name: str) -> bytes | None:
        """None for a program that is not there, is damaged, or may be another user's."""
        contents = read_private(self._path(name)) if self._is_private() else None
        if contents is None:
            return None
        digest, data = contents[:_DIGEST_BYTES], contents[_DIGEST_BYTES:]
        return data if self._digest(name, data) == digest else None

    def _digest(self, name: str, data: bytes) -> bytes:
        return hashlib.sha256(self._path(name).name.encode() + b"\0" + data).digest()

    def _is_private(self) -> bool:
        """Returns whether the folder is this user's alone; of one that is this user's, others' rights are taken first."""
        try:
            status = self._folder.stat()
            if stranger_to(status) is not None:
                make_private(self._folder)
                status = self._folder.stat()
        except OSError:
            return False
        reason = stranger_to(status)
        if reason is not None:
            _say_once(
                f"programs kept in {self._folder} are not used: it {reason}; JAX_COMPILATION_CACHE_DIR names another folder"
            )
        return reason is None


@functools.cache
def _say_once(line: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # a stream that is closed, or none
        print(line, file=sys.stderr)
