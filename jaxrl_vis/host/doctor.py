"""Self-test of an installation, with one line of output per check."""

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.host.devices import cache_fault, check_devices, enable_compilation_cache


def versions() -> str:
    """Return the versions of Python and of relevant packages.

    Raises:
        ModuleNotFoundError: A package is missing.
    """
    installed = provenance.versions()
    # The checkout itself does not have to be installed.
    missing = [name for name, version in installed.items() if version == provenance.NOT_INSTALLED and name != "jaxrl-vis"]
    if missing:
        raise ModuleNotFoundError(f"{', '.join(missing)} missing; install this project with `pip install .`")
    return ", ".join(f"{name} {version}" for name, version in installed.items())


def devices() -> str:
    """Return the platform and the device that JAX uses.

    Raises:
        RequestError: See `check_devices`.
    """
    check_devices()
    return f"{provenance.device_record()['platform']}: {provenance.device_name()}"


def memory() -> str:
    """Return the memory of the host and of the first device."""
    import jax

    host = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    text = f"host {host / 2**30:.1f} GiB" if host else "host unknown"
    limit = (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
    return text + (f", device {limit / 2**30:.1f} GiB usable" if limit else "")


def compilation_cache() -> str:
    """Return the folder of the compilation cache, or why it is off.

    Raises:
        PermissionError: The cache cannot be used.
    """
    import jax

    folder = enable_compilation_cache()
    fault = cache_fault()
    if fault is None:
        return folder
    if not jax.config.jax_enable_compilation_cache:
        return f"off, every run compiles again: {fault}"
    raise PermissionError(fault)


def physics_and_camera() -> str:
    """Compile and run one control step, render it, and check that the image is neither empty nor equal to the goal
    image.

    Raises:
        FloatingPointError: The state is not finite.
        ValueError: A check of the image fails.
    """
    import jax
    import jax.numpy as jnp

    import jaxrl_vis_envs

    env = jaxrl_vis_envs.make("VisualReacher", image_size=32)
    start = time.perf_counter()

    def step_once(key: jax.Array) -> tuple[jax.Array, Any]:
        state = env.step(env.reset(key), jnp.full((env.action_size,), 0.5, jnp.float32))
        return state.achieved_state, state.obs

    position, obs = jaxrl_vis_envs.jit(step_once, runs_once=True)(jax.random.key(0))
    if not bool(jnp.isfinite(position).all()):
        raise FloatingPointError("the state after one physics step is not finite")
    frame, goal = obs["observation"], obs["desired_goal"]
    if int(frame.max()) == int(frame.min()):
        raise ValueError("the image is empty")
    if bool((frame == goal).all()):
        raise ValueError("the image is equal to the goal image")
    size = "x".join(map(str, frame.shape))
    return f"one step of {env.name} and its {size} image in {time.perf_counter() - start:.1f} s, compilation included"


def renderer() -> str:
    """Render a ball on a floor, and check depths and segmentation against the known geometry.

    Raises:
        ValueError: A depth or a label is wrong.
    """
    import jax
    import mujoco
    import numpy as np

    from jaxrl_vis_envs.render import Scene, render

    model = mujoco.MjModel.from_xml_string(_BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene, size = Scene.from_mjmodel(model, camera="above", height=33, width=33), 33
    frame = jax.tree.map(np.asarray, jax.jit(lambda scene: render(scene, data))(scene))
    middle, corner = (size // 2, size // 2), (0, 0)
    ball, floor = float(frame.depth[middle]), float(frame.depth[corner])
    if (int(frame.segmentation[corner]), int(frame.segmentation[middle])) != (0, 1):
        raise ValueError("the image shows other objects than there are")
    if abs(ball - 1.5) > 1e-3 or abs(floor - 2.0) > 1e-3:
        raise ValueError(f"depths are {ball:.4f} and {floor:.4f} m instead of 1.5 and 2 m")
    return f"depths and objects of a {size}x{size} image are right"


_BALL = """
<mujoco>
  <worldbody>
    <camera name="above" pos="0 0 2" fovy="45"/>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <geom name="ball" type="sphere" pos="0 0 .25" size=".25"/>
  </worldbody>
</mujoco>
"""


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("versions", versions),
    ("devices", devices),
    ("memory", memory),
    ("compile cache", compilation_cache),
    ("environment", physics_and_camera),
    ("renderer", renderer),
)


def main(further_checks: Sequence[tuple[str, Callable[[], str]]] = (), findings: dict[str, Any] | None = None) -> int:
    """Run all checks, even after failures, and print the results.

    Args:
        further_checks: Further checks, by name.
        findings: Filled with ``passed`` and ``text`` of each check, by name.

    Returns:
        0 if all checks pass; 1 if one fails; 2 if JAX is configured for a device that is not available, which stops the checks.
    """
    failures, checks = 0, (*CHECKS, *further_checks)
    for name, check in checks:
        try:
            verdict, text = "ok  ", check()
        except RequestError as error:
            print(f"FAIL  {name:14} {error}", flush=True)
            return 2
        except Exception as error:  # noqa: BLE001 - every failure is reported
            failures += 1
            verdict, text = "FAIL", f"{type(error).__name__}: {' '.join(str(error).split())}"
        if findings is not None:
            findings[name] = {"passed": verdict != "FAIL", "text": text}
        print(f"{verdict}  {name:14} {text}", flush=True)
    print("all is well" if not failures else f"{failures} of {len(checks)} checks failed")
    return 1 if failures else 0
