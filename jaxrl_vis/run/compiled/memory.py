"""Memory checks of a run, before anything is allocated."""

import math
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.parallel.sharding import ONE_DEVICE, Layout

# Memory left unclaimed: XLA's workspaces and the allocator's gaps on an accelerator, the program and its libraries on a host.
_SLACK_BYTES = 256 * 2**20

# Copies of one rollout in addition to the replay: the scan's frames in time-major order, then in the replay's order, and the
# float activations of a part of them.
_ROLLOUT_COPIES = 3

# Copies of the parameters and optimiser states: gradients, updates, and arrays that XLA does not update in place.
_TRAIN_COPIES = 2

# Float32 copies of a batch's images in a gradient step, including hidden layers; measured with XLA's memory_analysis (preset
# cpu, one and three seeds). On an accelerator, `check_compiled` checks again with the compiler's own figures.
_BATCH_COPIES = 30


def tree_bytes(shapes: Any) -> int:
    """Count the bytes of all arrays (or their shapes) in a pytree; a typed key counts as 8 bytes of key data."""

    def size(leaf: Any) -> int:
        item = 8 if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf.dtype.itemsize
        return math.prod(leaf.shape) * item

    return sum(size(leaf) for leaf in jax.tree.leaves(shapes))


def available_bytes(device: Any = None) -> int | None:
    """Return the free memory of a device or, for a CPU, of the host and its container, in bytes; None if unknown.

    On hosts without ``/proc/meminfo``, all of the host's memory counts as free.

    Args:
        device: JAX device; None for the first of this process.
    """
    device = jax.local_devices()[0] if device is None else device
    if device.platform != "cpu":
        statistics = device.memory_stats() or {}
        if "bytes_limit" not in statistics:
            return None
        return int(statistics["bytes_limit"] - statistics.get("bytes_in_use", 0))
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return min(int(line.split()[1]) * 1024, _container_bytes())
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def _container_bytes() -> int:
    """Return the bytes left by a container's limit (cgroup version 2); a very large number if there is none."""
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text(encoding="ascii").strip()
        used = int((group / "memory.current").read_text(encoding="ascii"))
        # Cached files count as used, but are evicted on demand.
        statistics = dict(line.split() for line in (group / "memory.stat").read_text(encoding="ascii").splitlines())
        return int(limit) - used + int(statistics.get("inactive_file", 0))
    except (OSError, ValueError):
        return 2**62


def format_bytes(count: float) -> str:
    """Format a size as ``1.5 GiB``: always in GiB, so that any two sizes can be compared at a glance."""
    gib = count / 2**30
    return f"{gib:.1f} GiB" if gib >= 0.1 else f"{gib:.3f} GiB" if gib >= 0.001 else "under 0.001 GiB"


def _available_bytes(layout: Layout) -> int | None:
    """Return the free memory of each of the run's devices, in bytes: the minimum of all, or an equal share of the host's for
    CPUs; None if unknown.
    """
    if layout.mesh is None:
        return available_bytes()
    if layout.devices[0].platform == "cpu":  # all of them share the host's memory
        host_bytes = available_bytes()
        return None if host_bytes is None else host_bytes // len(layout.devices)
    available = [available_bytes(device) for device in layout.devices]
    return None if None in available else min(count for count in available if count is not None)


def check_memory(
    config: Config,
    loop_shapes: Any,
    replay_bytes: int,
    steps_per_iteration: int,
    layout: Layout = ONE_DEVICE,
    frame_stack: int = 1,
) -> str:
    """Estimate a run's memory, and compare it with a device's free memory.

    Args:
        config: Configuration of the run.
        loop_shapes: Shapes and dtypes of the loop state, of all seeds.
        replay_bytes: Bytes of one seed's replay.
        steps_per_iteration: Environment steps of one seed in an iteration; the replay's capacity is a multiple of it.
        layout: Placement of the run.
        frame_stack: Images stacked in an observation; the replay stores only one of them, rollouts and batches all.

    Returns:
        A summary, such as ``replay 0.3 GiB of 22.0 GiB``.

    Raises:
        RequestError: The run does not fit. The message suggests what would.
    """
    capacity = math.ceil(config.run.replay_transitions / steps_per_iteration) * steps_per_iteration
    parts = layout.shards.count
    fraction = parts / layout.num_devices  # fraction of the seeds on each device
    train = max(0, tree_bytes(loop_shapes) - replay_bytes * config.run.seeds) * fraction
    replay = replay_bytes * config.run.seeds * fraction / parts
    bytes_per_rollout = replay * steps_per_iteration / capacity
    collected = bytes_per_rollout * frame_stack
    batch = collected / steps_per_iteration * config.run.batch_size * 4
    other_bytes = train * (1 + _TRAIN_COPIES) + collected * _ROLLOUT_COPIES + batch * _BATCH_COPIES + _SLACK_BYTES
    available, suffix = _available_bytes(layout), "" if layout.num_devices == 1 else " a device"
    if available is None:
        return f"replay {format_bytes(replay)}{suffix}"
    if replay + other_bytes > available:
        fitting = int((available - other_bytes) // bytes_per_rollout) * steps_per_iteration
        if fitting > 0:
            hint = f"--replay-transitions {fitting} fits"
        else:
            hint = "not even one rollout fits: lower --num-envs, --image-size or --seeds"
        seeds = "1 seed" if config.run.seeds == 1 else f"{config.run.seeds} seeds"
        raise RequestError(
            f"a replay of {config.run.replay_transitions} transitions for {seeds} needs "
            f"{format_bytes(replay)}{suffix}, and networks and rollouts {format_bytes(other_bytes)} more; there are "
            f"{format_bytes(available)}{suffix}: {hint}"
        )
    return f"replay {format_bytes(replay)} of {format_bytes(available)}{suffix}"


def check_compiled(programs: dict[str, Any], is_allocated: bool, layout: Layout = ONE_DEVICE) -> bool:
    """Compare the compiler's own figures with the free memory, before anything is allocated.

    Args:
        programs: Compiled programs by name; must include ``learn`` if the loop state is still to be allocated.
        is_allocated: True if the loop state is already on the device.
        layout: Placement of the run; the compiler's figures are those of one device.

    Returns:
        True if all programs fit into memory at once, so that one may be launched while another still runs, or if the free
        memory is unknown.

    Raises:
        RequestError: A program's scratch memory does not fit beside the state.
    """
    available = _available_bytes(layout)
    if available is None:
        return True
    state, scratch = _sizes(programs)
    held = 0 if is_allocated else state
    for name, size in scratch.items():
        if size + held > available:
            raise RequestError(
                f"{name} needs {format_bytes(size)} of scratch memory beside a state of {format_bytes(state)}; there are "
                f"{format_bytes(available)}: lower --num-envs, --eval-episodes, --batch-size or --replay-transitions"
            )
    return sum(scratch.values()) + held <= available


def _sizes(programs: dict[str, Any]) -> tuple[int, dict[str, int]]:
    """Return the compiler's figures for one device, in bytes: the arguments of ``learn`` (0 without it), scratch by program.

    Scratch memory includes results that do not reuse an argument's memory; that of ``init`` is left out.
    """
    analyses = {name: program.memory_analysis() for name, program in programs.items()}
    training = analyses.get("learn")
    scratch = {
        name: analysis.temp_size_in_bytes + analysis.output_size_in_bytes - analysis.alias_size_in_bytes
        for name, analysis in analyses.items()
        if analysis is not None and name != "init"
    }
    return training.argument_size_in_bytes if training else 0, scratch
