"""Tests of the direction of imports, and of the wheel outside the checkout."""

import ast
import fnmatch
import functools
import graphlib
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Folders and single files of jaxrl_vis. A folder imports from earlier rows only; files of one row do not import each other. A
# file of a folder may have a row of its own.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors", "host"),  # `host` itself is empty
    ("config", "types"),
    ("weighting",),  # a library of its own: nothing of this project but `errors` and `types`
    ("host.cache_entries", "host.provenance", "host.spreadsheets", "host.streams"),
    ("host.files",),
    ("host.devices", "host.distributed", "host.plugins", "host.weights_file"),
    ("learner",),
    ("report",),
    ("recordings",),
    ("indicator", "run"),
    ("host.worker_pool", "studies"),
    ("bench", "host.doctor"),
    ("host.platform_report",),
    ("cli.parsing",),  # the part of the command line that commands of `stalks` are written with
    ("cli.checks",),
    ("stalks",),
    ("cli",),
    ("__main__",),
)
# The same for the environments.
ENVIRONMENT_LAYERS: tuple[tuple[str, ...], ...] = (
    ("checks", "compiling", "cores", "documents", "goals", "names"),
    ("physics",),
    ("plants", "render", "task_modules"),
    ("randomization",),
    ("base",),
    ("pixels", "registry"),
    ("tasks",),
    ("adapters",),
)
PACKAGES = {"jaxrl_vis": (ROOT / "jaxrl_vis", LAYERS), "jaxrl_vis_envs": (ROOT / "envs" / "jaxrl_vis_envs", ENVIRONMENT_LAYERS)}


@functools.cache
def imported(path: Path, when_running: bool = True) -> frozenset[str]:
    """Return the full names of all modules that a file imports; `from a import b` counts as a.b.

    Args:
        path: The file.
        when_running: If true, leave out imports for type checkers only.
    """
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    for_types = [node for block in blocks if "TYPE_CHECKING" in ast.unparse(block.test) for node in ast.walk(block)]
    for node in ast.walk(tree):
        if when_running and node in for_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def modules_of(package: str) -> dict[str, Path]:
    """Return the files of a package by module name, without its own ``__init__``, whose names are imported lazily."""
    folder, _ = PACKAGES[package]
    parts = {path: path.relative_to(folder).with_suffix("").parts for path in folder.rglob("*.py")}
    return {
        ".".join((package, *(part for part in names if part != "__init__"))): path
        for path, names in parts.items()
        if names != ("__init__",)
    }


def imports_within(package: str, when_running: bool) -> dict[str, set[str]]:
    """Return, for each module of a package, the modules of the package that it imports; see `imported`."""
    modules = modules_of(package)
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        graph[name] = set()
        for full in imported(path, when_running):
            # `from a.b import c`: c is a module of a.b, or a name in it.
            target = full if full in modules else full.rpartition(".")[0]
            if target in modules and target != name:
                graph[name].add(target)
    return graph


@pytest.mark.parametrize("package", PACKAGES)
def test_arrows_run_one_way(package: str) -> None:
    _, layers = PACKAGES[package]
    depth_of = {name: depth for depth, names in enumerate(layers) for name in names}

    def unit_of(module: str) -> str:
        folder, file = module.split(".")[1], ".".join(module.split(".")[1:3])
        return file if file in depth_of else folder

    for name, targets in imports_within(package, when_running=False).items():
        unit = unit_of(name)
        assert unit in depth_of, f"{unit} has no layer: give it one"
        for target in targets:
            other = unit_of(target)
            assert other == unit or depth_of[other] < depth_of[unit], f"{name} must not import {target}"


def test_the_farm_has_one_door_that_opens_on_request(clean_environment: dict[str, str]) -> None:
    outside = [
        *(path for path in (ROOT / "jaxrl_vis").rglob("*.py") if "stalks" not in path.relative_to(ROOT).parts),
        *(ROOT / "envs" / "jaxrl_vis_envs").rglob("*.py"),
    ]
    arrows = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in outside
        for name in imported(path, when_running=False)
        if f"{name}.".startswith("jaxrl_vis.stalks.")
    }
    assert arrows == {("jaxrl_vis/cli/__init__.py", "jaxrl_vis.stalks.cli.COMMANDS")}
    code = """
import sys
from jaxrl_vis import cli
cli.main(["--version"])
assert "jaxrl_vis.stalks" not in sys.modules
cli.main(["--help"])
assert "jaxrl_vis.stalks" in sys.modules and not {"jax", "numpy", "cv2"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_imports_go_in_circles(package: str) -> None:
    """Circles count among the files of a folder, too, and through imports for types only or inside functions."""
    sorter = graphlib.TopologicalSorter(imports_within(package, when_running=False))
    sorter.prepare()  # raises CycleError, which names the circle


def test_the_world_knows_nothing_of_the_learner() -> None:
    for path in (ROOT / "envs" / "jaxrl_vis_envs").rglob("*.py"):
        roots = {name.split(".")[0] for name in imported(path)}
        assert not roots & {"jaxrl_vis", "flax", "optax", "orbax", "envs"}, path


def test_packages_do_not_import_the_scripts_outside_the_wheel() -> None:
    for folder, _ in PACKAGES.values():
        for path in folder.rglob("*.py"):
            assert "benchmarks" not in {name.split(".")[0] for name in imported(path, when_running=False)}, path


def test_the_scalar_engine_has_one_door() -> None:
    """Modules outside its folder import only its two functions and the probe of its kernel."""
    folder, door = ROOT / "envs" / "jaxrl_vis_envs" / "physics" / "scalar", "jaxrl_vis_envs.physics.scalar"
    for path in [*(ROOT / "jaxrl_vis").rglob("*.py"), *(ROOT / "envs").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]:
        inside = {name.removeprefix(f"{door}.") for name in imported(path) if name.startswith(f"{door}.")}
        assert path.is_relative_to(folder) or inside <= {"simulate", "supports", "probe"}, path


def test_nothing_imports_the_folder_of_sources() -> None:
    for path in [*(ROOT / "jaxrl_vis").rglob("*.py"), *(ROOT / "tests").rglob("*.py"), *(ROOT / "notebooks").rglob("*.py")]:
        assert "envs" not in {name.split(".")[0] for name in imported(path)}, path


def test_leaves_load_no_mujoco(clean_environment: dict[str, str]) -> None:
    code = """
import sys
from jaxrl_vis import indicator
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.ddpg import losses
from jaxrl_vis.learner.networks import networks
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.memory import relabel
from jaxrl_vis.learner.memory import replay
from jaxrl_vis_envs import goals
assert not {"mujoco", "matplotlib", "orbax"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_the_library_of_weightings_loads_jax_and_optax_alone(clean_environment: dict[str, str]) -> None:
    """Users with their own losses need no command line, physics, networks or import hook."""
    code = """
import sys
import jax, jax.numpy, jax.extend.core, numpy, optax
before, finders, hooks = set(sys.modules), list(sys.meta_path), list(sys.path_hooks)
import jaxrl_vis.weighting as jw
more = {name for name in set(sys.modules) - before if not name.startswith("jaxrl_vis.weighting")}
ours = {"jaxrl_vis", "jaxrl_vis.errors", "jaxrl_vis.types", "jaxrl_vis_envs", "jaxrl_vis_envs.names"}
assert {name for name in more if name.startswith("jaxrl")} == ours, more
assert {name.split(".")[0] for name in more - ours} <= set(sys.stdlib_module_names) | {"jax", "jaxlib", "numpy", "optax"}, more
assert (sys.meta_path, sys.path_hooks) == (finders, hooks)
assert not {"mujoco", "flax", "orbax", "tyro", "rich", "matplotlib"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_importing_the_package_loads_no_jax(clean_environment: dict[str, str]) -> None:
    code = "import sys, jaxrl_vis; jaxrl_vis.preset('cpu'); assert not {'jax', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_mjx_does_not_print_that_warp_is_missing(clean_environment: dict[str, str]) -> None:
    """The message is printed neither by importing our modules, nor by importing MJX after them."""
    for code in ("import jaxrl_vis_envs.physics; from mujoco import mjx", "import jaxrl_vis_envs.adapters.brax_viewer"):
        done = subprocess.run([sys.executable, "-c", code], env=clean_environment, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


# A box of eight corners above a plane, as a mesh.
_MESH = """
import sys, jaxrl_vis_envs.physics, mujoco
from mujoco import mjx
assert not {"trimesh", "scipy.spatial"} & set(sys.modules)
box = "0 0 1  1 0 1  0 1 1  0 0 2  1 1 1  1 0 2  0 1 2  1 1 2"
model = mujoco.MjModel.from_xml_string(
    f"<mujoco><asset><mesh name='box' vertex='{box}'/></asset><worldbody><geom type='plane' size='1 1 1'/>"
    "<body><freejoint/><geom type='mesh' mesh='box'/></body></worldbody></mujoco>"
)
convex = mjx.put_model(model)._impl.mesh_convex
assert convex[0].face.shape == (6, 4, 3), convex[0].face.shape
import trimesh, scipy.spatial
assert trimesh.Trimesh.__module__ == "trimesh.base" and scipy.spatial.ConvexHull
"""


def test_mjx_loads_libraries_for_meshes_only_where_there_are_meshes(clean_environment: dict[str, str]) -> None:
    subprocess.run([sys.executable, "-c", _MESH], env=clean_environment, check=True)


def test_importing_the_environments_changes_no_imports(clean_environment: dict[str, str]) -> None:
    """Only their physics adds the import hook that makes MJX faster; the module of names loads no JAX."""
    code = (
        "import sys; finders = list(sys.meta_path); import jaxrl_vis_envs.names;"
        "assert sys.meta_path == finders and not {'jax', 'mujoco'} & set(sys.modules);"
        "import jaxrl_vis_envs.physics; assert len(sys.meta_path) == len(finders) + 1"
    )
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_names_load_no_jax(clean_environment: dict[str, str]) -> None:
    code = "import sys, jaxrl_vis_envs.names, jaxrl_vis.errors; assert not {'jax', 'numpy', 'mujoco'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def test_pins_carry_no_address_and_every_hash() -> None:
    files = sorted((ROOT / "requirements").glob("*.txt"))
    assert [file.name for file in files] == ["base.txt", "dev.txt", "docs.txt", "gpu.txt"]
    for file in files:
        text = file.read_text()
        assert "://" not in text
        assert "--index-url" not in text and "--find-links" not in text
        pins = [line for line in text.splitlines() if line and not line.startswith((" ", "#"))]
        assert pins and all("==" in pin for pin in pins)
        assert text.count("--hash=sha256:") >= len(pins)


def test_notice_says_where_each_file_comes_from_that_is_not_code() -> None:
    entries = re.findall(r"((?:^\S+/\S+\n)+)((?:    .*\n)+)", (ROOT / "NOTICE").read_text(), re.MULTILINE)
    assert all("    Licence: " in text for _, text in entries)
    patterns = [pattern for files, _ in entries for pattern in files.split()]
    shipped = [
        path.relative_to(ROOT).as_posix()
        for folder, _ in PACKAGES.values()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc", ".typed")
    ]
    assert shipped and [name for name in shipped if not any(fnmatch.fnmatch(name, pattern) for pattern in patterns)] == []
    assert [pattern for pattern in patterns if not fnmatch.filter(shipped, pattern)] == []


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--sdist", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


def test_sdist_holds_the_licence_and_the_notice(wheel: Path) -> None:
    with tarfile.open(next(wheel.parent.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"LICENSE", "NOTICE", "pyproject.toml", "README.md"} <= names


def test_wheel_holds_both_packages_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"jaxrl_vis", "jaxrl_vis_envs"}
    here = {path.relative_to(ROOT / "envs").as_posix() for path in (ROOT / "envs").rglob("*.xml")}
    assert here and here <= set(names)
    assert "jaxrl_vis/studies/data/ol_aux_curves.csv" in names
    assert [name.rpartition("/")[2] for name in names if "/licenses/" in name] == ["LICENSE", "NOTICE"]
    # Without these, type checkers take no notice of the annotations of an installed package.
    assert {"jaxrl_vis/py.typed", "jaxrl_vis_envs/py.typed"} <= set(names)


def test_wheel_is_small(wheel: Path) -> None:
    """Limits on code, and on other files without the pretrained policies, are raised only on purpose."""
    sizes = {
        file.filename: file.compress_size for file in zipfile.ZipFile(wheel).infolist() if "/pretrained/" not in file.filename
    }
    assert sum(size for name, size in sizes.items() if not name.endswith(".py")) <= 7_300_000
    assert sum(size for name, size in sizes.items() if name.endswith(".py")) <= 1_200_000
    assert max(file.file_size for file in zipfile.ZipFile(wheel).infolist()) <= 5_000_000


def test_wheel_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    code = f"""
import jaxrl_vis, jaxrl_vis.cli, jaxrl_vis.learner.train_step, jaxrl_vis_envs
for package in (jaxrl_vis, jaxrl_vis_envs):
    assert package.__file__.startswith({str(site)!r}), package.__file__
env = jaxrl_vis_envs.make("FetchReach")
assert env.action_size == 4
assert jaxrl_vis.cli.main(["--version"]) == 0
"""
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
