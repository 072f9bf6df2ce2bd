"""Stale records: those older than the code that they measured.

Every benchmark lists the files that it measures. A record is stale if one of them has a definition (a function, a class or
another top-level statement; the whole contents of a file that is not Python) that did not exist anywhere at the record's
revision. Moved and renamed files, comments, docstrings, annotations of functions, imports and error messages therefore do not
count. A renamed variable does: only a new measurement can show that it changed no figure.
"""

import ast
import dataclasses
import functools
import hashlib
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.ledger.records import CHECKOUT, is_cpu_record, read_all
from jaxrl_vis.host import provenance

_ENVS = "envs/jaxrl_vis_envs"
_PHYSICS = tuple(f"{_ENVS}/{name}" for name in ("base.py", "goals.py", "compiling", "physics", "tasks/mjx_env.py"))
_RENDERER = (f"{_ENVS}/render",)
_IMAGES = (*_RENDERER, f"{_ENVS}/pixels/observations.py")
_WRAPPED = (*_RENDERER, f"{_ENVS}/pixels", "benchmarks/pixels/playground.py")
_TASK = (f"{_ENVS}/tasks/{{task}}.py", f"{_ENVS}/tasks/assets/{{task}}.xml")
_LEARNER = ("jaxrl_vis/learner", "jaxrl_vis/weighting", "jaxrl_vis/config")
_TIMING = "jaxrl_vis/bench/timing.py"
_PEERS = "benchmarks/peers"
_SCENES = ("jaxrl_vis/bench/scenes/images.py", "jaxrl_vis/bench/scenes/models.py", _TIMING)

MEASURED: dict[str, tuple[str, ...]] = {
    "render/images": (*_IMAGES, *_TASK, "jaxrl_vis/bench/render.py", _TIMING),
    "render/scene": (*_RENDERER, *_SCENES),
    "render/peer_mujoco": (*_SCENES, f"{_PEERS}/mujoco.py"),
    "render/peer_warp": (*_SCENES, f"{_PEERS}/warp.py"),
    "physics/steps": (*_PHYSICS, *_TASK, "jaxrl_vis/bench/physics.py", _TIMING),
    "physics/peer_playground": (f"{_PEERS}/playground.py", _TIMING),
    "pixels/steps": ("benchmarks/pixels/playground.py", "benchmarks/pixels/speed.py", _TIMING),
    "pixels/steps_with_images": (*_WRAPPED, "benchmarks/pixels/speed.py", _TIMING),
    **{
        f"pixels/{figure}": (*_WRAPPED, "benchmarks/pixels/train.py", "benchmarks/pixels/training_tasks.py")
        for figure in ("return", "speed_to_900", "success", "speed_to_0.8")
    },
    "env/steps": (*_PHYSICS, *_IMAGES, *_TASK, "jaxrl_vis/bench/env.py", _TIMING),
    "update/gradient_steps": (*_LEARNER, "jaxrl_vis/bench/update.py", _TIMING),
    "update/peer_torch": (f"{_PEERS}/torch", _TIMING),
    "train/env_steps": (*_PHYSICS, *_IMAGES, *_TASK, *_LEARNER, "jaxrl_vis/bench/train.py", _TIMING),
    "train/updates": (*_PHYSICS, *_IMAGES, *_TASK, *_LEARNER, "jaxrl_vis/bench/train.py", _TIMING),
    **{
        f"scaling/{kind}": (*_PHYSICS, *_IMAGES, *_TASK, *_LEARNER, "benchmarks/scaling.py")
        for kind in ("seeds", "weak", "strong", "processes_seeds", "processes_weak")
    },
    "scaling/all_reduce": ("jaxrl_vis/learner/parallel/shards.py", "benchmarks/scaling.py"),
    "adapters/success": (*_PHYSICS, *_TASK, f"{_ENVS}/adapters", f"{_PEERS}/agents.py"),
    "learning": (*_PHYSICS, *_IMAGES, *_TASK, *_LEARNER),
}
"""Measured files and folders by name of the record; ``{task}`` stands for the file of the record's environment."""

# MuJoCo's own renderer, used only by tests and videos.
_NEVER = (f"{_ENVS}/render/reference.py",)
# Prefixes of code for the other kind of device.
_ON_CPU = (f"{_ENVS}/render/cpu",)
_ON_GPU = (f"{_ENVS}/render/gpu", "jaxrl_vis/learner/networks/kernels")
# Folders of the definitions at a revision.
_SOURCES = ("jaxrl_vis", "envs", "benchmarks")
_SHOWN = 4  # number of changed files in a message


@dataclasses.dataclass(frozen=True)
class Stale:
    """Stale records of one file, name, revision and reason.

    Attributes:
        file: File of records.
        name: Name of the records.
        revision: Revision of the records.
        count: Number of records.
        reason: Changes since then, as text.
    """

    file: str
    name: str
    revision: str
    count: int
    reason: str

    def __str__(self) -> str:
        records = "1 record" if self.count == 1 else f"{self.count} records"
        return f"stale: {self.file}: {records} {self.name} of {self.revision}: {self.reason}"


def stale_records(folder: Path, checkout: Path = CHECKOUT) -> list[Stale]:
    """Find the stale records in ``folder``, grouped by file, name, revision and reason, and sorted in this order.

    Records of one file, name and revision can have several reasons, as these depend on the environment and the kind of device.

    Args:
        folder: Folder of records, see `records.read_all`.
        checkout: Git checkout of the records' revisions. Its working tree is compared.

    Raises:
        RequestError: The folder does not exist, or a file in it cannot be read.
        FileNotFoundError: A file listed in `MEASURED` does not exist.
    """
    groups: dict[tuple[str, str, str, str], int] = {}
    reason_once = functools.cache(functools.partial(staleness_reason, checkout=checkout))
    for path, record in read_all(folder):
        reason = reason_once(record["name"], record["config"].get("env"), is_cpu_record(record), record["revision"])
        if reason is not None:
            key = (path.relative_to(folder).as_posix(), record["name"], record["revision"], reason)
            groups[key] = groups.get(key, 0) + 1
    return [Stale(file, name, revision, count, reason) for (file, name, revision, reason), count in sorted(groups.items())]


def staleness_reason(name: str, env: str | None, on_cpu: bool, revision: str, checkout: Path) -> str | None:
    """Describe the changes since ``revision`` in the code that a record measures; return None if there are none.

    Args:
        name: Name of the record.
        env: Environment of the record; None if it has none.
        on_cpu: True if a CPU was measured.
        revision: Revision of the record.
        checkout: Git checkout of the revision.

    Returns:
        The first changed files and definitions; or that the record, its revision or its code is unknown.

    Raises:
        FileNotFoundError: A file listed in `MEASURED` does not exist.
    """
    if name not in MEASURED:
        return f"which code {name} measures is unknown: add it to MEASURED in {Path(__file__).name}"
    if revision.endswith("-dirty"):
        return "it was measured with changes that were never committed"
    then = definitions_at(revision, checkout)
    if then is None:
        return "its revision is not in this repository"
    changed = []
    for path in measured_files(name, env, on_cpu, checkout):
        new = [word for digest, word in definitions(path.suffix, path.read_bytes()) if digest not in then]
        if new:
            words = [word for word in dict.fromkeys(new) if word]
            shown = ", ".join(words[:3]) + (", ..." if len(words) > 3 else "")
            changed.append(path.name + (f" ({shown})" if shown else ""))
    more = f" and {len(changed) - _SHOWN} more files" if len(changed) > _SHOWN else ""
    return f"changed since: {', '.join(changed[:_SHOWN])}{more}" if changed else None


def measured_files(name: str, env: str | None, on_cpu: bool, checkout: Path) -> Iterator[Path]:
    """Yield the files of `MEASURED` that are used on the device of a record.

    Raises:
        FileNotFoundError: A listed file does not exist.
    """
    for pattern in MEASURED[name]:
        task = None if env is None else task_module(env)
        if "{task}" in pattern and task is None:
            continue
        path = checkout / pattern.format(task=task)
        if path.suffix == ".xml" and not path.exists():
            path = path.parent  # the task modifies models of others
        if not path.exists():
            raise FileNotFoundError(f"{path} is named in MEASURED of {Path(__file__).name}, and is not there")
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            left_out = file.relative_to(checkout).as_posix().startswith(_NEVER + (_ON_GPU if on_cpu else _ON_CPU))
            if file.is_file() and "__pycache__" not in file.parts and not left_out:
                yield file


def task_module(env: str) -> str | None:
    """Return the module in `tasks` of an environment, such as fetch_reach for ``VisualFetchReach``; None if not built in."""
    from jaxrl_vis_envs import registry

    if not registry.is_built_in(env):
        return None
    return registry.config_class(env).__module__.rpartition(".")[2]


@functools.cache
def definitions_at(revision: str, checkout: Path) -> frozenset[str] | None:
    """Return the digests of all definitions at a revision; None if the repository does not have it."""
    listing = provenance.git("ls-tree", "-r", revision, "--", *_SOURCES, folder=checkout)
    if listing is None:
        return None
    blobs = {}
    for line in listing.splitlines():
        facts, path = line.split("\t", 1)
        blobs[facts.split()[2]] = Path(path).suffix
    digests: set[str] = set()
    for blob, contents in _read_blobs(blobs, checkout):
        digests |= {digest for digest, _ in definitions(blobs[blob], contents)}
    return frozenset(digests)


def _read_blobs(blobs: Iterable[str], checkout: Path) -> Iterator[tuple[str, bytes]]:
    names = list(blobs)
    command = ("git", "-C", str(checkout), "cat-file", "--batch")
    output = subprocess.run(command, input="\n".join(names).encode() + b"\n", capture_output=True, check=True).stdout
    position = 0
    for name in names:
        end = output.index(b"\n", position)
        length = int(output[position:end].split()[2])
        yield name, output[end + 1 : end + 1 + length]
        position = end + 1 + length + 1


@functools.cache  # revisions share most of their files
def definitions(suffix: str, contents: bytes) -> tuple[tuple[str, str], ...]:
    """Return digest and name ("" for none) of every top-level statement of a Python file, or of any other file as a whole."""
    if suffix != ".py":
        return ((hashlib.sha256(contents).hexdigest(), ""),)
    statements = []
    for statement in ast.parse(contents).body:
        if isinstance(statement, ast.Import | ast.ImportFrom) or _is_text(statement):
            continue
        plain: Any = _InertCodeRemover().visit(statement)
        names = [plain.name] if hasattr(plain, "name") else [target.id for target in _targets(plain)]
        statements.append((hashlib.sha256(ast.dump(plain).encode()).hexdigest(), ", ".join(names)))
    return tuple(statements)


def _targets(statement: ast.AST) -> list[ast.Name]:
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    return [target for target in targets if isinstance(target, ast.Name)]


def _is_text(statement: ast.AST) -> bool:
    return (
        isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant) and isinstance(statement.value.value, str)
    )


class _InertCodeRemover(ast.NodeTransformer):
    """Remover of code without effect on a figure: docstrings, imports, function annotations, error messages."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        body = getattr(node, "body", None)
        if isinstance(body, list):
            statements = [part for part in body if not _is_text(part) and not isinstance(part, ast.Import | ast.ImportFrom)]
            node.body = statements or [ast.Pass()]  # pyright: ignore[reportAttributeAccessIssue]
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise(exc=None, cause=None)
