"""Renderer as an ordinary JAX function: any batch size, inside ``vmap``, ``scan`` and ``grad``, on any backend.

Example::

    scene = Scene.from_mjmodel(mj_model, camera="name", height=64, width=64)
    frame = render(scene, data)                       # rgb, depth, segmentation of one environment; vmap for a batch
    planes = render_planes(scene, data, rgb=False)    # the hot path: only the requested planes, never interleaved

Modules, in the order in which data passes through them; each imports only from the rows above it::

    mounts       poses of cameras and lights, from the poses of bodies
    model/       reads a `mujoco.MjModel` into NumPy arrays: colours, lights, lens, triangles, texture atlas, paths of tendons
    cords        poses of the capsules of tendons, from the poses of sites
    viewpoint    camera pose and lens, intrinsic matrix, points from depths
    scene        `Scene`, a pytree of all of the above; `outputs`: the requested and the returned planes
    camera       pixel rays, and spheres in view
    pixel/       the per-pixel mathematics in plain JAX, for every backend: unit shapes and lights once per environment;
                 nearest object per pixel; its depth, normal, texture and colour
    cpu/, gpu/   the same image, faster: in passes over tiles on a CPU, in one kernel on an NVIDIA GPU
    images       `render` and `render_planes`, which select one of the three

Each fast path reproduces the plain path in `pixel`, including its derivatives, for the scenes that it supports. The path is
selected by the platform that a program is compiled for (`jaxrl_vis_envs.compiling.compilation.dispatch_by_platform`).
"""

from jaxrl_vis_envs.render.images import quantize, render, render_planes
from jaxrl_vis_envs.render.outputs import Frame, Planes
from jaxrl_vis_envs.render.scene import Scene

__all__ = ["Frame", "Planes", "Scene", "quantize", "render", "render_planes"]
