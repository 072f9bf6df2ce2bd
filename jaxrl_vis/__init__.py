"""Training of robots that reach goals given only as images.

    config = jaxrl_vis.preset("fast", env="VisualFetchReach")
    trainer = jaxrl_vis.make_trainer(config)
    for report in trainer.run(): ...
    policy = jaxrl_vis.load_policy(run_dir)     # observation, goal -> action

Importing the package does not import JAX; accessing the trainer does.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public name -> the module that holds it, imported at first use.
_HOMES = {
    "Config": "jaxrl_vis.config",
    "Policy": "jaxrl_vis.run.trained.policy",
    "RequestError": "jaxrl_vis.errors",
    "load_policy": "jaxrl_vis.run.trained.policy",
    "preset": "jaxrl_vis.config",
    "Trainer": "jaxrl_vis.run.trainer",
    "make_trainer": "jaxrl_vis.run.trainer",
}

if TYPE_CHECKING:
    from jaxrl_vis.config import Config, preset
    from jaxrl_vis.errors import RequestError
    from jaxrl_vis.run.trained.policy import Policy, load_policy
    from jaxrl_vis.run.trainer import Trainer, make_trainer

__all__ = ["Config", "Policy", "RequestError", "Trainer", "__version__", "load_policy", "make_trainer", "preset"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
