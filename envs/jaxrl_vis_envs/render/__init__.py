"""Images as an ordinary JAX function: any batch, any subset, inside ``vmap``, ``scan`` and ``grad``, on any backend.

Example::

    scene = Scene.from_mjmodel(mj_model, camera="name", height=64, width=64)
    frame = render(scene, data)                       # rgb, depth, segmentation of one environment; vmap for a batch
    planes = render_planes(scene, data, rgb=False)    # the hot path: only what is asked for, never interleaved
"""

from jaxrl_vis_envs.render.images import Frame, Planes, quantize, render, render_planes
from jaxrl_vis_envs.render.scene import Scene

__all__ = ["Frame", "Planes", "Scene", "quantize", "render", "render_planes"]
