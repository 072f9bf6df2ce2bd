"""Settings of a benchmark, with device-dependent defaults."""

import dataclasses
from typing import Any, Self

import jax

from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs import registry


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a benchmark.

    If None or empty, ``pixels`` depends on the device, ``image_size`` and ``envs`` on the device and the benchmark, and
    ``preset``, ``batch_size`` and ``data_devices`` are the defaults of the benchmark.

    Attributes:
        env: Name of the environment.
        preset: Preset of the networks and gradient steps.
        envs: Batch sizes in environments (or images), with one measurement for each; unused by the benchmark update.
        image_size: Height and width of images.
        pixels: Channels: rgbd, rgb or depth.
        batch_size: Number of transitions per gradient step.
        seeds: Number of learners in one program.
        devices: Number of devices.
        data_devices: Number of devices that share each learner; see `Config`.
        repeats: Maximum number of timed repeats; see `timing.measure`.
        aux_tasks, weighting: Auxiliary losses of the gradient steps, empty for none, and their weighting.
        scene: Scene of `scenes.models`, or path of an MJCF file, to render instead of ``env``; None to render ``env``.
        on_accelerator: True if JAX runs on an accelerator; set by `for_this_device`.
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
    aux_tasks: tuple[str, ...] = ()
    weighting: str = "none"
    scene: str | None = None
    on_accelerator: bool = False

    def for_this_device(self) -> Self:
        """Return a copy with the defaults that depend on the device alone; each benchmark fills in its own sizes."""
        accelerator = jax.default_backend() != "cpu"
        return dataclasses.replace(self, pixels=self.pixels or ("rgbd" if accelerator else "depth"), on_accelerator=accelerator)

    @property
    def size(self) -> int:
        """Height and width of images: the requested one, or the default for this kind of device."""
        return self.image_size or (64 if self.on_accelerator else 32)

    def batch_sizes(self, cpu: tuple[int, ...], accelerator: tuple[int, ...]) -> tuple[int, ...]:
        """Return the batch sizes to measure: the requested ones, or the defaults for this kind of device."""
        return self.envs or (accelerator if self.on_accelerator else cpu)

    @property
    def has_images(self) -> bool:
        """True if the observations of the environment are images: its configuration then has a field for their channels."""
        return "pixels" in {field.name for field in dataclasses.fields(registry.config_class(self.env))}

    def make_env(self, **overrides: Any) -> Any:
        """Build the environment, with these image settings if its observations are images.

        Raises:
            RequestError: The environment is unknown, or rejects the settings.
        """
        images = dict(image_size=self.size, pixels=self.pixels) | overrides
        try:
            return registry.make(self.env, **(images if self.has_images else {}))
        except ValueError as error:
            raise RequestError(str(error)) from error

    def image_config(self) -> dict[str, Any]:
        """Return the entries of a record for the measured environment."""
        if not self.has_images:
            return {"env": self.env}
        return dict(env=self.env, image_size=self.size, pixels=self.pixels)

    def preset_config(self) -> dict[str, str]:
        """Return the entry of a record for the preset; empty for the default of the device."""
        return {} if self.preset is None else {"preset": self.preset}

    def seeds_config(self) -> dict[str, int]:
        """Return the entry of a record for the number of learners; empty for one."""
        return {"seeds": self.seeds} if self.seeds > 1 else {}

    def devices_config(self) -> dict[str, int]:
        """Return the entries of a record for the devices; empty for one."""
        if self.devices == 1:
            return {}
        return {"devices": self.devices} | ({} if self.data_devices is None else {"data_devices": self.data_devices})

    def auxiliary_config(self) -> dict[str, Any]:
        """Return the entries of a record for auxiliary losses; empty without them."""
        if self.weighting == "none":
            return {}
        return dict(weighting=self.weighting, aux_tasks=" ".join(self.aux_tasks))
