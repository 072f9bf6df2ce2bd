"""Options of commands that use the images of a task without training a policy."""

import dataclasses
from typing import Annotated, Any

from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.config import Config, Pixels, preset


@dataclasses.dataclass(frozen=True)
class TaskImages:
    """Options for the images of a task."""

    env: Annotated[str, AlsoPositional()] = "VisualFetchReach"
    """Environment with images: a name listed by `jaxrl-vis envs`, or module:Name for a custom one."""
    pixels: Pixels = "rgbd"
    """Channels of the images."""
    image_size: int = 64
    """Height and width of the images, in pixels."""
    env_options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    seed: int = 0
    """Random seed."""

    def config(self, **changes: Any) -> Config:
        """Return the preset ``fast`` with these images, without random shifts, and with further ``changes`` by name."""
        return preset(
            "fast",
            env=self.env,
            pixels=self.pixels,
            image_size=self.image_size,
            env_options=self.env_options,
            random_shift=0,
            **changes,
        )
