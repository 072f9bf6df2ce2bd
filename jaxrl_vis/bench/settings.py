"""What a benchmark is asked to measure, with defaults that suit the device."""

import dataclasses
from typing import Any, Self

import jax

from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs import registry


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to measure. None and the empty tuple stand for a default that suits the device.

    Attributes:
        env: The environment.
        preset: Whose networks and gradient steps are measured.
        envs: Environments (or images) side by side; one measurement each.
        image_size: Height and width of images.
        pixels: Channels: rgbd, rgb or depth.
        batch_size: Transitions in a gradient step.
        seeds: Learners side by side in one program.
        devices: How many to use.
        data_devices: How many of them share each learner; see `Config`.
        repeats: Timed repeats at most; see `timing.measure`.
        peer: Another renderer, another physics, or PyTorch, to measure beside ours.
        aux_tasks, weighting: Auxiliary losses in gradient steps, and their weighting.
        scene: A scene of `render_scenes`, or the path of an MJCF file, to draw instead of an environment.
        on_accelerator: Whether JAX runs on one; filled in by `for_this_device`.
    """

    env: str = "VisualFetchReach"
    preset: str | None = None
    envs: tuple[int, ...] = ()
    image_size: int | None = None
    pixels: str | None = None
    batch_size: int | None = None
    seeds: int = 1
    devices: int = 1
    data_devices: int | None = None
    repeats: int = 5
    peer: str | None = None
    aux_tasks: tuple[str, ...] = ()
    weighting: str = "none"
    scene: str | None = None
    on_accelerator: bool = False

    def for_this_device(self) -> Self:
        """Fills in what depends on the device alone; each benchmark fills in its own sizes."""
        accelerator = jax.default_backend() != "cpu"
        return dataclasses.replace(
            self,
            image_size=self.image_size or (64 if accelerator else 32),
            pixels=self.pixels or ("rgbd" if accelerator else "depth"),
            on_accelerator=accelerator,
        )

    def counts(self, cpu: tuple[int, ...], accelerator: tuple[int, ...]) -> tuple[int, ...]:
        """How many environments to measure: the numbers that were asked for, or the device's defaults."""
        return self.envs or (accelerator if self.on_accelerator else cpu)

    @property
    def has_images(self) -> bool:
        """Whether the environment's observations are images: then its configuration says which channels they have."""
        return "pixels" in {field.name for field in dataclasses.fields(registry.config_class(self.env))}

    def make_env(self, **overrides: Any) -> Any:
        """The environment; where its observations are images, with these settings of them.

        Raises:
            RequestError: There is no such environment, or it cannot be made like that.
        """
        images = {"image_size": self.image_size, "pixels": self.pixels, **overrides}
        try:
            return registry.make(self.env, **(images if self.has_images else {}))
        except ValueError as error:
            raise RequestError(str(error)) from error

    def image_config(self) -> dict[str, Any]:
        """What a record says about the environment that was measured."""
        if not self.has_images:
            return {"env": self.env}
        return {"env": self.env, "image_size": self.image_size, "pixels": self.pixels}

    def preset_config(self) -> dict[str, str]:
        """What a record says about the preset; nothing of the device's own, as in records from before that."""
        return {} if self.preset is None else {"preset": self.preset}

    def seeds_config(self) -> dict[str, int]:
        """What a record says about the number of learners; nothing of one, as records from before there could be several."""
        return {"seeds": self.seeds} if self.seeds > 1 else {}

    def devices_config(self) -> dict[str, int]:
        """What a record says about devices; nothing of one."""
        if self.devices == 1:
            return {}
        return {"devices": self.devices} | ({} if self.data_devices is None else {"data_devices": self.data_devices})

    def auxiliary_config(self) -> dict[str, Any]:
        """What a record says about auxiliary losses; nothing where there are none."""
        if self.weighting == "none":
            return {}
        return {"weighting": self.weighting, "aux_tasks": " ".join(self.aux_tasks)}
