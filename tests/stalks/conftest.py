"""Fixtures of the tests of stalk counting and measuring."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def plots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small synthetic plots with true masks."""
    from phenotype_plots import write_plots

    return write_plots(tmp_path_factory.mktemp("phenotype"))


@pytest.fixture(scope="session")
def results(plots: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of `phenotype run` on these plots."""
    from phenotype_plots import run

    out = tmp_path_factory.mktemp("results") / "out"
    assert run(plots, out) == 0
    return out
