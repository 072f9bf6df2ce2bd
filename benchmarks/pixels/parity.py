"""Comparison of images of a wrapped task with `mujoco.Renderer`'s: at its start, and after random actions."""

import dataclasses
from typing import Any

import jax
import mujoco
import numpy as np
import render_models
from render_comparison import Tally, surface_kinds

from benchmarks.pixels import playground
from benchmarks.rendering.reference import ReferenceRenderer
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.render import Frame

ENVIRONMENTS, STEPS = 4, 20  # starts, and random actions from each to a second image


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Images of one task from both renderers.

    Attributes:
        camera: Name of the camera.
        ours: Our frames (NumPy): `ENVIRONMENTS` initial states, then the states of the same environments after random actions.
        theirs: The same states rendered by `mujoco.Renderer`.
        tally: Accumulated differences between the two.
    """

    camera: str
    ours: list[Frame]
    theirs: list[Frame]
    tally: Tally

    def row(self, task: str, size: int) -> dict[str, Any]:
        """Return the row of the record for a ``task`` rendered with images of ``size`` x ``size`` pixels."""
        measures = {name: None if np.isnan(value) else round(value, 5) for name, value in self.tally.measures().items()}
        images = {"images": len(self.ours), "size": size, "device": jax.devices()[0].device_kind}
        return {"task": task, "camera": self.camera, **images, "measures": measures, "failures": self.tally.failures()}


def compare(task: str, size: int) -> Comparison:
    """Render a task with both renderers.

    Shadows, reflections and multisampling are off, and OpenGL's polygons are fine, as in `benchmarks.render_parity`.
    """
    env = playground.load(task)
    mj_model, camera = env.mj_model, playground.camera(env)
    outputs = ("rgb", "depth", "segmentation")
    wrapped = pixels.wrap(env, camera, size, outputs, site_groups=playground.SITE_GROUPS, lights="mujoco")
    first, last = (jax.tree.map(np.asarray, part) for part in _run(wrapped))
    ours, theirs, tally = [], [], Tally(surface_kinds(mj_model))
    with ReferenceRenderer(_finely_drawn(mj_model, size), size, size, site_groups=playground.SITE_GROUPS) as reference:
        for poses, images in (first, last):
            for index in range(ENVIRONMENTS):
                frame = Frame(*(images[output][index] for output in outputs))
                ours.append(frame)
                theirs.append(reference(_mj_data(mj_model, poses, index), camera))
                tally.add(frame, theirs[-1])
    return Comparison(camera, ours, theirs, tally)


def _run(env: pixels.PixelEnv) -> tuple[Any, Any]:
    """Return poses and images of the starts, and of the states after random actions; steps in between render no images."""

    def run(key: jax.Array) -> list[tuple[Any, Any]]:
        start_key, action_key = jax.random.split(key)
        start = jax.vmap(env.env.reset)(jax.random.split(start_key, ENVIRONMENTS))

        def step(state: Any, step_key: jax.Array) -> tuple[Any, None]:
            actions = jax.random.uniform(step_key, (ENVIRONMENTS, env.action_size), minval=-1.0, maxval=1.0)
            return jax.vmap(env.env.step)(state, actions), None

        end = jax.lax.scan(step, start, jax.random.split(action_key, STEPS))[0]
        return [(_poses(state.data), jax.vmap(env.render_views)(state)[camera]) for state in (start, end)]

    (camera,) = env.views.outputs
    first, last = jax.jit(run, compiler_options=compiler_options(runs_once=True))(jax.random.PRNGKey(0))
    return first, last


def _poses(data: Any) -> dict[str, jax.Array]:
    return {name: getattr(data, name) for name in ("qpos", "mocap_pos", "mocap_quat")}


def _mj_data(mj_model: mujoco.MjModel, poses: dict[str, np.ndarray], index: int) -> mujoco.MjData:
    mj_data = mujoco.MjData(mj_model)
    for name, values in poses.items():
        getattr(mj_data, name)[:] = values[index]
    mujoco.mj_forward(mj_model, mj_data)
    return mj_data


def _finely_drawn(mj_model: mujoco.MjModel, size: int) -> mujoco.MjModel:
    """Set options of MuJoCo's renderer in place, and return the model: fine polygons, no multisampling, a large buffer."""
    quality, buffer = mj_model.vis.quality, mj_model.vis.global_
    quality.numslices, quality.numstacks, quality.numquads = render_models.SLICES, render_models.STACKS, render_models.QUADS
    quality.offsamples = 0
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, size), max(buffer.offheight, size)
    return mj_model
