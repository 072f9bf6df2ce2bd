"""Measure the complexity of the source: sizes, imports, lists of option names, and calls from command line to critic loss.

    python benchmarks/complexity.py [--json FILE] [--without-calls]

Calls are the frames of this project's own files in the traceback of an exception that is raised in ``critic_loss`` while
``jaxrl-vis train`` traces it. A list of option names is a tuple, list, set or dictionary with two or more names of
configuration fields, outside of the configuration's definition.
"""

import argparse
import ast
import dataclasses
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("jaxrl_vis", "envs", "benchmarks")
STALKS = ("phenotyping", "grasping", "plants", "stalks")
"""Folders of the stalks product, which are counted separately."""

_RAISE = """
import sys, traceback
from jaxrl_vis.learner.ddpg import losses
from jaxrl_vis import cli

source = "def critic_loss(*arguments, **options):\\n    raise LookupError('critic_loss was called')"
exec(compile(source, losses.__file__, "exec"), vars(losses))
sys.argv[1:] = ["train", "VisualReacher", "--preset", "debug", "--run-dir", {folder!r}]
try:
    cli.entry()
except LookupError as error:
    for frame in traceback.extract_tb(error.__traceback__)[1:]:
        if {root!r} in frame.filename:
            print("FRAME", frame.filename[len({root!r}) + 1:], frame.name)
"""


def sources() -> list[Path]:
    """List the Python files of the packages and of the benchmarks."""
    return sorted(path for folder in SOURCES for path in (ROOT / folder).rglob("*.py"))


def is_of_stalks(path: Path) -> bool:
    """Return True if a file belongs to the stalks product, by its folder or its name."""
    parts = path.relative_to(ROOT).parts
    return bool(set(parts) & set(STALKS)) or path.name.startswith(("phenotype", "grasp", "stalk", "families"))


def field_names() -> set[str]:
    """Return the names of all fields of the configuration, including those of its groups."""
    from jaxrl_vis.config import Config

    names, pending = set(), [Config]
    while pending:
        record = pending.pop()
        for field in dataclasses.fields(record):
            names.add(field.name)
            if isinstance(field.type, type) and dataclasses.is_dataclass(field.type):
                pending.append(field.type)
    return names


def lists_of_names(path: Path, names: set[str]) -> list[int]:
    """Return the line numbers at which tuples, lists, sets or dictionaries with two or more field names begin."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Dict):
            items: list[ast.expr | None] = list(node.keys)
        elif isinstance(node, ast.Tuple | ast.List | ast.Set):
            items = list(node.elts)
        else:
            continue
        if sum(isinstance(item, ast.Constant) and item.value in names for item in items if item is not None) >= 2:
            lines.append(node.lineno)
    return lines


def own_imports(path: Path) -> int:
    """Count this project's modules that a file imports."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names if alias.name.startswith("jaxrl_vis")}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxrl_vis"):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                modules.add(full if _is_module(full) else node.module)
    return len(modules)


def _is_module(name: str) -> bool:
    place = Path(*name.split("."))
    return any((root / place).is_dir() or (root / place.with_suffix(".py")).exists() for root in (ROOT, ROOT / "envs"))


def calls() -> list[str]:
    """Return the frames of own files from the command line to the critic's loss, as lines ``PATH FUNCTION``.

    Raises:
        RuntimeError: Training does not call the critic's loss.
    """
    with tempfile.TemporaryDirectory() as folder:
        code = _RAISE.format(root=str(ROOT), folder=f"{folder}/run")
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    frames = [line.removeprefix("FRAME ") for line in done.stdout.splitlines() if line.startswith("FRAME ")]
    if not frames:
        raise RuntimeError(f"critic_loss was not reached: {done.stdout}\n{done.stderr}")
    return frames


def measure(with_calls: bool = True) -> dict[str, Any]:
    """Compute all measures by name; all but "fullest folder" and "lines of the stalks" exclude the stalks product.

    Args:
        with_calls: Whether to include the calls to the critic's loss, which takes some seconds.
    """
    files, names = sources(), field_names()
    ours = [path for path in files if not is_of_stalks(path)]
    packages = [path for path in ours if path.relative_to(ROOT).parts[0] != "benchmarks"]
    folders = Counter(path.parent for path in files if path.name != "__init__.py")
    fullest, count = folders.most_common(1)[0]
    imports = sorted(own_imports(path) for path in packages)
    learner = [path for path in packages if path.relative_to(ROOT).parts[0] == "jaxrl_vis"]
    outside = [path for path in learner if not path.relative_to(ROOT / "jaxrl_vis").parts[0].startswith("config")]
    lists = [line for path in outside for line in lists_of_names(path, names)]
    measured: dict[str, Any] = {
        "lines": sum(len(path.read_text().splitlines()) for path in ours),
        "files": len(ours),
        "lines of the stalks": sum(len(path.read_text().splitlines()) for path in files if is_of_stalks(path)),
        "fields of the configuration": len(names),
        "lists of field names": len(lists),
        "fullest folder": f"{fullest.relative_to(ROOT)} ({count} files)",
        "own imports, 90th percentile": imports[int(0.9 * (len(imports) - 1))],
    }
    if with_calls:
        frames = calls()
        measured |= {"calls to critic_loss": len(frames), "frames": frames}
    return measured


def main() -> int:
    """Print the measures, and write them to ``--json`` if given; return 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the measures")
    parser.add_argument("--without-calls", action="store_true", help="trace nothing")
    options = parser.parse_args()
    measured = measure(not options.without_calls)
    for name, value in measured.items():
        print(f"{name:32}{value}" if not isinstance(value, list) else "\n".join(f"    {line}" for line in value))
    if options.json is not None:
        options.json.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
