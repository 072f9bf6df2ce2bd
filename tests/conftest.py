"""Tests run on the CPU, whatever else there is, and compile each program once for all workers and runs."""

import getpass
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

# Read by JAX at its first import, so set before any test module is imported.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"jaxrl-vis-tests-{getpass.getuser()}"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("MPLBACKEND", "Agg")
# Programs of tests run for a moment: optimising their machine code takes longer. What XLA makes of them is the same.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=1"

import jax
import pytest


@pytest.fixture
def strict_promotion() -> Iterator[None]:
    """Implicit promotion of dtypes or ranks is an error. For the learner's leaves; MJX relies on both."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture
def checkout() -> Path:
    """The folder that holds pyproject.toml."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture
def clean_environment(checkout: Path) -> dict[str, str]:
    """Environment variables for a subprocess that imports the checkout."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(checkout), str(checkout / "envs")))}


# What takes longest, first: at the end of a run no worker should wait for the other.
LONGEST = ("HandReach", "SawyerReach", "FetchReach", "FingerTurn", "Reacher")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share compiled programs run in one process: those of one group, or else of one file."""

    def group(item: pytest.Item) -> str:
        mark = item.get_closest_marker("xdist_group")
        return mark.args[0] if mark else item.path.stem

    for item in items:
        item.add_marker(pytest.mark.xdist_group(group(item)))
    items.sort(key=lambda item: LONGEST.index(group(item)) if group(item) in LONGEST else len(LONGEST))
