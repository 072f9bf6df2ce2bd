"""Imports run one way, and what is shipped works outside the checkout."""

import ast
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# A module imports from earlier layers only.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("config", "types"),
    ("normalizer", "losses", "encoder_kernel"),
    ("networks",),
    ("replay", "relabel", "ddpg", "rollout"),
    ("train_step",),
    ("*",),  # the trainer's own files: those that stand nowhere else; they may import each other
    ("trainer",),
    ("bench", "doctor", "gallery"),
    ("cli",),
)
LAYER = {name: depth for depth, names in enumerate(LAYERS) for name in names}


def imported(path: Path) -> set[str]:
    """Every module that a file imports when it runs, by full name; `from a import b` counts as a.b."""
    found = set()
    tree = ast.parse(path.read_text())
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    for_types = [node for block in blocks if "TYPE_CHECKING" in ast.unparse(block.test) for node in ast.walk(block)]
    for node in ast.walk(tree):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def unit_of(module: str) -> str | None:
    """The file or folder of jaxrl_vis that a full name lies in."""
    parts = module.split(".")
    return parts[1] if parts[0] == "jaxrl_vis" and len(parts) > 1 else None


def test_arrows_run_one_way() -> None:
    package = ROOT / "jaxrl_vis"
    units = {path: path.relative_to(package).parts[0].removesuffix(".py") for path in package.rglob("*.py")}
    assert {name for name in LAYER if name != "*"} <= set(units.values())
    for path, unit in units.items():
        if unit == "__init__":
            continue
        depth = LAYER.get(unit, LAYER["*"])
        for name in imported(path):
            other = unit_of(name)
            if other not in units.values() or other == unit:
                continue
            other_depth = LAYER.get(other, LAYER["*"])
            assert other_depth < depth or other_depth == depth == LAYER["*"], f"{unit} must not import {other}"


def test_the_world_knows_nothing_of_the_learner() -> None:
    for path in (ROOT / "envs" / "jaxrl_vis_envs").rglob("*.py"):
        roots = {name.split(".")[0] for name in imported(path)}
        assert not roots & {"jaxrl_vis", "flax", "optax", "orbax", "envs"}, path


def test_nothing_imports_the_folder_of_sources() -> None:
    for path in [*(ROOT / "jaxrl_vis").rglob("*.py"), *(ROOT / "tests").rglob("*.py"), *(ROOT / "notebooks").rglob("*.py")]:
        assert "envs" not in {name.split(".")[0] for name in imported(path)}, path


def test_leaves_load_no_mujoco(clean_environment: dict[str, str]) -> None:
    code = """
import sys
import jaxrl_vis.replay, jaxrl_vis.relabel, jaxrl_vis.losses, jaxrl_vis.normalizer, jaxrl_vis.networks, jaxrl_vis_envs.goals
assert not {"mujoco", "matplotlib", "orbax"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_importing_the_package_loads_no_jax(clean_environment: dict[str, str]) -> None:
    code = "import sys, jaxrl_vis; jaxrl_vis.preset('cpu'); assert not {'jax', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_pins_carry_no_address_and_every_hash() -> None:
    files = sorted((ROOT / "requirements").glob("*.txt"))
    assert [file.name for file in files] == ["base.txt", "dev.txt", "gpu.txt"]
    for file in files:
        text = file.read_text()
        assert "://" not in text
        assert "--index-url" not in text and "--find-links" not in text
        pins = [line for line in text.splitlines() if line and not line.startswith((" ", "#"))]
        assert pins and all("==" in pin for pin in pins)
        assert text.count("--hash=sha256:") >= len(pins)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


def test_wheel_holds_both_packages_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"jaxrl_vis", "jaxrl_vis_envs"}
    here = {path.relative_to(ROOT / "envs").as_posix() for path in (ROOT / "envs").rglob("*.xml")}
    assert here and here <= set(names)


def test_wheel_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    code = f"""
import jaxrl_vis, jaxrl_vis.cli, jaxrl_vis.train_step, jaxrl_vis_envs
for package in (jaxrl_vis, jaxrl_vis_envs):
    assert package.__file__.startswith({str(site)!r}), package.__file__
env = jaxrl_vis_envs.make("FetchReach")
assert env.action_size == 4
assert jaxrl_vis.cli.main(["--version"]) == 0
"""
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
