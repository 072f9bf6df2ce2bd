"""What a benchmark is asked to measure, with sizes that suit the device filled in."""

import dataclasses
from typing import Any, Self


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to measure. None and the empty tuple stand for what suits the device.

    Attributes:
        env: The task.
        envs: Environments (or images) side by side; one measurement each.
        image_size: Height and width of images.
        pixels: Channels: rgbd, rgb or depth.
        batch_size: Transitions in a gradient step.
        repeats: Timed repeats at most; see `timing.measure`.
        peer: Another renderer, or another's physics, to measure side by side.
        scene: A scene of `render_scenes`, or the path of an MJCF file, to be drawn in the place of a task.
        on_accelerator: Whether JAX runs on one; filled in by `for_this_device`.
    """

    env: str = "VisualFetchReach"
    envs: tuple[int, ...] = ()
    image_size: int | None = None
    pixels: str | None = None
    batch_size: int | None = None
    repeats: int = 5
    peer: str | None = None
    scene: str | None = None
    on_accelerator: bool = False

    def for_this_device(self) -> Self:
        """Fills in what depends on the device alone; each benchmark fills in its own sizes."""
        import jax

        accelerator = jax.default_backend() != "cpu"
        return dataclasses.replace(
            self,
            image_size=self.image_size or (64 if accelerator else 32),
            pixels=self.pixels or ("rgbd" if accelerator else "depth"),
            on_accelerator=accelerator,
        )

    def counts(self, cpu: tuple[int, ...], accelerator: tuple[int, ...]) -> tuple[int, ...]:
        """The environments to measure: those asked for, or the device's own."""
        return self.envs or (accelerator if self.on_accelerator else cpu)

    def make_env(self, **overrides: Any) -> Any:
        """The task, with these images where it makes images."""
        import jaxrl_vis_envs

        images = {"image_size": self.image_size, "pixels": self.pixels, **overrides}
        return jaxrl_vis_envs.make(self.env, **(images if self.env.startswith("Visual") else {}))

    def image_config(self) -> dict[str, Any]:
        """What a record says about the world that was measured."""
        if not self.env.startswith("Visual"):
            return {"env": self.env}
        return {"env": self.env, "image_size": self.image_size, "pixels": self.pixels}
