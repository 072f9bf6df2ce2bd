"""Cache of traced programs on disk, so that a run that has been traced once starts without tracing.

XLA's cache avoids recompilation of a program, but not the tracing before it, which is Python and takes seconds. Programs are
stored as StableHLO (`jax.export`), next to XLA's cache: reading them runs no code.

A program belongs to one fingerprint: the code of both packages, the versions of the libraries, the configuration, JAX's
settings and the device. It does not cover changes made to modules at runtime (such as a patched loss). So only commands use the
cache, not scripts and notebooks, and only without custom parts. ``JAXRL_VIS_KEEP_PROGRAMS=0`` turns it off.

A stored program determines what a run computes. So folder and files are private to the user, files that another user has or
could have written are not read, and a file's digest also covers its name.
"""

import contextlib
import functools
import hashlib
import importlib.util
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
from jax import export
from jax.extend.core import jaxpr_as_fun

import jaxrl_vis_envs
from jaxrl_vis.config import HOST, Config, marked
from jaxrl_vis.host.files import foreign_writer, make_private, read_private, replacing
from jaxrl_vis.host.plugins import custom_names
from jaxrl_vis.host.provenance import device_record, versions
from jaxrl_vis.learner.acting.evaluate import Evaluation
from jaxrl_vis.learner.acting.rollout import Exploration
from jaxrl_vis.learner.iteration import Learned
from jaxrl_vis.types import Episodes
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compiling.compilation import target_platform, tracing_for_default_device, use_gpu_kernels

CACHE_VARIABLE = "JAXRL_VIS_KEEP_PROGRAMS"
MAX_FILES = 300
"""Maximum number of files, of half a megabyte each; the oldest are deleted."""

_PACKAGES = ("jaxrl_vis", "jaxrl_vis_envs")
_DIGEST_BYTES = 32
# JAX warns that another jaxlib may interpret Triton's programs differently; the fingerprint includes the version.
_CHECKS = (export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton"),)
# Node types registered with `jax.export`, and an instance of each type that occurs only in signatures of programs.
_registered: set[type] = set()
_SIGNATURES = (Episodes(0, 0, 0), Exploration(), Learned(0, {}), Evaluation({}, {}))  # type: ignore[arg-type]
# Settings of what JAX writes, and where, which change no program. Folders may differ between runs.
_WITHOUT_EFFECT = ("cache", "log", "dump", "dir", "timeout", "traceback")


def fingerprint(config: Config, env: GoalEnv, learner: Any = None) -> str | None:
    """Compute a hexadecimal digest of everything that a run's programs depend on; None if they must not be cached.

    Args:
        config: Configuration of the run.
        env: Its environment.
        learner: Tree of the learner, or of a policy; only its structure counts.
    """
    is_ours = type(env).__module__.partition(".")[0] in _PACKAGES and not custom_names(config)
    if not is_ours or os.environ.get(CACHE_VARIABLE) == "0":
        return None
    settings = {name: value for name, value in jax.config.values.items() if not any(part in name for part in _WITHOUT_EFFECT)}
    with tracing_for_default_device():
        target = [target_platform(), use_gpu_kernels()]
    # The seed is an argument of the programs, as keys.
    compiled_in = {name: value for name, value in config.flat().items() if name not in (*marked(HOST), "seed")}
    depends_on = [compiled_in, str(jax.tree.structure(learner)), versions(), device_record(), target, settings, _code()]
    return hashlib.sha256(json.dumps(depends_on, sort_keys=True, default=repr).encode()).hexdigest()


@functools.cache
def _code() -> str:
    """Compute a digest of all files of both packages, including models and data."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        spec = importlib.util.find_spec(package)
        assert spec is not None and spec.origin is not None
        folder = Path(spec.origin).parent
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts):
            contents = path.read_bytes()
            digest.update(f"{package}/{path.relative_to(folder).as_posix()} {len(contents)}\n".encode() + contents)
    return digest.hexdigest()


class TraceCache:
    """Traced programs of one fingerprint.

    Args:
        folder: Folder of the files; it need not exist.
        fingerprint: From `fingerprint`.
        nodes: Tree with all node types of arguments and results, besides those of this package's own signatures.
        jit_options: Arguments of `jaxrl_vis_envs.jit` by name of the program.
    """

    def __init__(self, folder: Path, fingerprint: str, nodes: Any = None, jit_options: Mapping[str, Any] | None = None):
        self._folder, self._fingerprint, self._jit_options = folder, fingerprint, jit_options or {}
        self._fresh: dict[str, bytes] = {}
        self._nodes = nodes

    def lower(self, name: str, function: Any, arguments: tuple) -> Any:
        """Lower a function like ``function.lower``, from the stored program if there is one.

        Args:
            name: Name of the program.
            function: Jitted function.
            arguments: Shapes of its arguments, as trees.
        """
        _register((self._nodes, arguments, _SIGNATURES))
        data = self._read(name)
        if data is None:
            traced = function.trace(*arguments)
            call, results = jaxpr_as_fun(traced.jaxpr), jax.tree.structure(traced.out_info)
            again = jax.jit(lambda *arguments: jax.tree.unflatten(results, call(*jax.tree.leaves(arguments))))
            exported = export.export(again, platforms=(target_platform(),), disabled_checks=_CHECKS)(*arguments)
            self._fresh[name] = data = bytes(exported.serialize())
        # Also used right after tracing: XLA's cache distinguishes between a traced program and the same one read from a file.
        program = export.deserialize(bytearray(data))
        return jaxrl_vis_envs.jit(program.call, **self._jit_options.get(name, {})).lower(*arguments)

    def write(self) -> None:
        """Store the newly traced programs, and delete the oldest files beyond `MAX_FILES`; skipped if this is impossible."""
        with contextlib.suppress(OSError):
            make_private(self._folder)
            for name, data in self._fresh.items() if self._is_private() else ():
                with replacing(self._path(name), durable=False, mode=0o600) as file:
                    file.write(self._digest(name, data) + data)
            for path in sorted(self._folder.iterdir(), key=lambda path: path.stat().st_mtime)[:-MAX_FILES]:
                path.unlink(missing_ok=True)
        self._fresh.clear()

    def forget(self) -> None:
        """Delete the programs of this fingerprint."""
        self._fresh.clear()
        with contextlib.suppress(OSError):
            for path in self._folder.glob(f"*-{self._fingerprint}.stablehlo"):
                path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}-{self._fingerprint}.stablehlo"

    def _read(self, name: str) -> bytes | None:
        """Return a stored program; None if it is missing, damaged, or possibly written by another user."""
        contents = read_private(self._path(name)) if self._is_private() else None
        if contents is None:
            return None
        digest, data = contents[:_DIGEST_BYTES], contents[_DIGEST_BYTES:]
        return data if self._digest(name, data) == digest else None

    def _digest(self, name: str, data: bytes) -> bytes:
        return hashlib.sha256(self._path(name).name.encode() + b"\0" + data).digest()

    def _is_private(self) -> bool:
        """Return True if the folder is private to this user; first revoke the permissions of others if this user owns it.

        If not, print the reason to stderr, once per process.
        """
        try:
            status = self._folder.stat()
            if foreign_writer(status) is not None:
                make_private(self._folder)
                status = self._folder.stat()
        except OSError:
            return False
        reason = foreign_writer(status)
        if reason is not None:
            _print_once(
                f"programs kept in {self._folder} are not used: it {reason}; JAX_COMPILATION_CACHE_DIR names another folder"
            )
        return reason is None


def _register(tree: Any) -> None:
    """Register a tree's node types with `jax.export`, by the names of their classes."""
    pending = [jax.tree.structure(tree)]
    while pending:
        structure = pending.pop()
        pending += structure.children()
        kind, _ = structure.node_data() or (None, None)
        if kind is None or kind in _registered or kind in (tuple, list, dict, type(None)):
            continue
        _registered.add(kind)
        name = f"{kind.__module__}.{kind.__qualname__}"
        with contextlib.suppress(ValueError):  # registered by other code
            if issubclass(kind, tuple):
                export.register_namedtuple_serialization(kind, serialized_name=name)
            else:  # a dataclass all of whose fields are children
                export.register_pytree_node_serialization(
                    kind, serialized_name=name, serialize_auxdata=lambda data: b"", deserialize_auxdata=lambda data: ()
                )


@functools.cache
def _print_once(line: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # a stream that is closed, or none
        print(line, file=sys.stderr)
