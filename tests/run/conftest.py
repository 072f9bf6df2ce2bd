"""Fixtures of the tests of trained policies."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Trained runs, which tests leave as they are: two seeds on images, one seed on states."""
    from test_policy import SETTINGS, register

    import jaxrl_vis

    folder = tmp_path_factory.mktemp("policies")
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        for name, seeds in (("VisualTold", {"seed": 3, "seeds": 2}), ("Told", {})):
            # With a shared encoder, the actor alone is not all of a policy.
            config = jaxrl_vis.preset("debug", env=name, encoders="shared", **SETTINGS, **seeds)
            assert len(list(jaxrl_vis.make_trainer(config, folder / name).run())) == 3
    return {path.name: path for path in folder.iterdir()}
