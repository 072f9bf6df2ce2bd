"""Says whether this installation works, in one line for each check."""

import os
import time
from collections.abc import Callable
from typing import Any

from jaxrl_vis import provenance
from jaxrl_vis.devices import cache_fault, check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError


def versions() -> str:
    """Versions of Python and of the packages that matter."""
    found = provenance.versions()
    # The checkout itself need not be installed.
    missing = [name for name, version in found.items() if version == provenance.NOT_INSTALLED and name != "jaxrl-vis"]
    if missing:
        raise ModuleNotFoundError(f"{', '.join(missing)} missing; install this project with `pip install .`")
    return ", ".join(f"{name} {version}" for name, version in found.items())


def devices() -> str:
    """What JAX runs on."""
    check_devices()
    return f"{provenance.device_record()['platform']}: {provenance.device_name()}"


def memory() -> str:
    """Memory of the host and of the first device."""
    import jax

    host = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    text = f"host {host / 2**30:.1f} GiB" if host else "host unknown"
    limit = (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
    return text + (f", device {limit / 2**30:.1f} GiB usable" if limit else "")


def compilation_cache() -> str:
    """The folder where compiled programs are kept, and whether it can be written."""
    import jax

    folder = enable_compilation_cache()
    fault = cache_fault()
    if fault is None:
        return folder
    if not jax.config.jax_enable_compilation_cache:
        return f"off, every run compiles again: {fault}"
    raise PermissionError(fault)


def physics_and_camera() -> str:
    """Compiles and takes one control step, renders the result, and checks that the image shows something."""
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
        raise FloatingPointError("a number after one physics step is not finite")
    frame, goal = obs["observation"], obs["desired_goal"]
    if int(frame.max()) == int(frame.min()):
        raise ValueError("the image is empty")
    if bool((frame == goal).all()):
        raise ValueError("the image is equal to the goal image")
    size = "x".join(map(str, frame.shape))
    return f"one step of {env.name} and its {size} image in {time.perf_counter() - start:.1f} s, compilation included"


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("versions", versions),
    ("devices", devices),
    ("memory", memory),
    ("compile cache", compilation_cache),
    ("environment", physics_and_camera),
)


def main() -> int:
    """Runs every check, whatever came of the earlier ones, and says what it finds.

    Returns:
        0 where all is well; 1 where a check fails; 2 where JAX is asked for a device that is not there, which ends the checks.
    """
    failures = 0
    for name, check in CHECKS:
        try:
            verdict, text = "ok  ", check()
        except RequestError as error:
            print(f"FAIL  {name:14} {error}", flush=True)
            return 2
        except Exception as error:  # noqa: BLE001 - a doctor reports whatever is wrong
            failures += 1
            verdict, text = "FAIL", f"{type(error).__name__}: {' '.join(str(error).split())}"
        print(f"{verdict}  {name:14} {text}", flush=True)
    print("all is well" if not failures else f"{failures} of {len(CHECKS)} checks failed")
    return 1 if failures else 0
