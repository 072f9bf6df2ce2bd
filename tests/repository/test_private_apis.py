"""Tests that the private APIs of other libraries in use are those listed in docs/private_apis.md."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "private_apis.md"
# Public by documentation, although their names begin like private ones.
_OF_NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace", "_exit"}
_UNSTABLE = ("jax.extend", "jax.interpreters", "jaxlib")
_TEXT = re.compile(r"(_impl\.\w+|[\w.]+\._src\.[\w.]+|jaxlib\.[\w.]+|\.?orbax-checkpoint-tmp)")


def trees() -> dict[str, ast.Module]:
    """Return the syntax trees of the files of both packages, by path in the repository."""
    folders = (ROOT / "jaxrl_vis", ROOT / "envs" / "jaxrl_vis_envs")
    files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in files}


def own_names(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a file defines, attributes included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.arg):
            yield node.arg


def private_modules(node: ast.AST) -> Iterator[str]:
    """Yield the private or unstable modules, or names in them, that an import uses."""
    if isinstance(node, ast.Import):
        names = [(alias.name, alias.name) for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        names = [(f"{node.module}.{alias.name}", node.module or "") for alias in node.names]
    else:
        return
    for full, module in names:
        if full.startswith(_UNSTABLE) or (module.endswith("._src") and not full.startswith("jaxrl_vis")):
            yield full
        elif "._" in full and not full.startswith("jaxrl_vis"):
            yield module


def uses(tree: ast.Module, own: set[str]) -> Iterator[str]:
    """Yield the private APIs that a file uses: imports, attributes, and names in strings."""
    for node in ast.walk(tree):
        yield from private_modules(node)
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr) and node.attr not in own | _OF_NAMED_TUPLES:
            yield node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _TEXT.fullmatch(node.value):
            yield node.value


def rows() -> list[list[str]]:
    """Return the cells of the page's tables, without their headers."""
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_the_page_lists_every_use() -> None:
    code = trees()
    own = {name for tree in code.values() for name in own_names(tree)}
    in_code = {(part, path) for path, tree in code.items() for part in uses(tree, own)}
    on_page = {
        (part, path) for row in rows() for part in re.findall("`(.*?)`", row[0]) for path in re.findall("`(.*?)`", row[1])
    }
    assert in_code - on_page == set(), "add these to docs/private_apis.md"
    assert on_page - in_code == set(), "take these out of docs/private_apis.md"


def test_the_tests_that_notice_a_change_exist() -> None:
    for part, _, _, tests in rows():
        names = re.findall("`(.*?)`", tests)
        assert names, part
        for name in names:
            path, _, function = name.partition("::")
            assert f"\ndef {function}(" in (ROOT / path).read_text(), (part, name)
