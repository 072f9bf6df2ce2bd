"""Images as an ordinary JAX function: any batch, any subset, inside ``vmap``, ``scan`` and ``grad``, on any backend.

Example::

    scene = Scene.from_mjmodel(mj_model, camera="name", height=64, width=64)
    frame = render(scene, data)                       # rgb, depth, segmentation of one environment; vmap for a batch
    planes = render_planes(scene, data, rgb=False)    # the hot path: only what is asked for, never interleaved

Where things are, in the order in which data passes through; a file imports only from rows above its own::

    mounts       where cameras and lights are, from the poses of bodies
    model/       reads an `mujoco.MjModel` into NumPy arrays: colours, lights, lens, triangles, the atlas of textures
    scene        `Scene`, a pytree of all that; `outputs`: which planes are asked for, and what comes back
    camera       the camera's pose and the rays of the pixels
    pixel/       the mathematics in plain JAX, for every backend: unit shapes and lights once per environment; the nearest
                 object of each pixel; its depth, normal, texture and colour
    cpu/, gpu/   the same image, faster: as passes over tiles on a CPU, as one kernel on an NVIDIA GPU
    images       `render` and `render_planes`, which choose between the three
    reference    MuJoCo's own OpenGL renderer behind the same `Frame`, for tests and videos

Each fast path computes what the plain path in `pixel` computes, for the scenes that it takes, and has its derivatives. The
choice follows the platform that a program is compiled for (`jaxrl_vis_envs.compiling.compilation.dispatch_by_platform`).
"""

from jaxrl_vis_envs.render.images import quantize, render, render_planes
from jaxrl_vis_envs.render.outputs import Frame, Planes
from jaxrl_vis_envs.render.scene import Scene

__all__ = ["Frame", "Planes", "Scene", "quantize", "render", "render_planes"]
