"""Content of goal images: visibility of the relevant parts, and distinct goals with identical images.

    python -m benchmarks.tasks.goal_images [ENV ...] [--goals 1000] [--image-size 100]

For each visual task, over its goal images as observed by the agent (RGB-D bytes):

    visible      minimum and median number of pixels of each required part over all goals, and number of goals that show none
    identical    number of pairs of goals further apart than a threshold with the same image; must be 0
    nearest      minimum number of bytes in which two images differ, among pairs 1 to 1.5 thresholds apart

Exit status: 1 if two distinct goals look the same, or if a required part is occluded in a goal; else 0.
"""

import argparse
import os
import sys
from typing import Any, NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax  # noqa: E402
import numpy as np  # noqa: E402

import jaxrl_vis_envs  # noqa: E402
from jaxrl_vis_envs.render import Scene, render_planes  # noqa: E402

# Parts that must be visible, by the names of their geoms. Geoms in one tuple count together.
PARTS: dict[str, dict[str, tuple[str, ...]]] = {
    "VisualFetchPush": {"box": ("box",), "gripper": ("palm", "left_finger", "right_finger")},
    "VisualFetchReach": {"gripper": ("palm", "left_finger", "right_finger"), "fingers": ("left_finger", "right_finger")},
    "VisualFingerTurn": {"spinner tip": ("tip_marker",), "fingertip": ("fingertip",)},
    "VisualHandReach": {f"{tip} tip": (f"{tip}tip",) for tip in ("ff", "mf", "rf", "lf", "th")},
    "VisualPointMass": {"ball": ("ball",)},
    "VisualReacher": {"fingertip": ("fingertip",)},
    "VisualSawyerReach": {"gripper": ("palm", "left_finger", "right_finger"), "fingers": ("left_finger", "right_finger")},
    "VisualStalkReach": {"gripper": ("palm", "left_jaw", "right_jaw"), "stalks": tuple(f"upper_{index}" for index in range(4))},
}
_NEAR = 1.5  # thresholds
_BATCH = 25  # goals rendered at once


class Goals(NamedTuple):
    """Goals of a task: states [N, G] float32, images [N, C, H, W] uint8, visible geom of each pixel [N, H, W] int32."""

    states: np.ndarray
    images: np.ndarray
    labels: np.ndarray


def draw_goals(env: Any, count: int, seed: int = 0) -> Goals:
    """Sample the goals of ``count`` episodes with the random key ``seed``; render one frame and one segmentation each."""
    size = env.observation_spec.shape[-1]
    scene = Scene.from_mjmodel(env.mj_model, env.camera, size, size)

    def sample(key: jax.Array) -> Any:
        data = env.sample_goal(key)
        return env.achieved(data), data

    def draw(data: Any) -> tuple[jax.Array, jax.Array]:
        image = env.observe(env.state_at(data, env.achieved(data)).replace(history=None))
        return image[: len(image) // env.frame_stack], render_planes(scene, data, False, False, segmentation=True).segmentation

    keys = jax.random.split(jax.random.key(seed), count)
    states, data = jaxrl_vis_envs.jit(jax.vmap(sample))(keys)
    images, labels = jaxrl_vis_envs.jit(lambda data: jax.lax.map(draw, data, batch_size=_BATCH))(data)
    return Goals(np.asarray(states), np.asarray(images), np.asarray(labels))


def visible_pixels(env: Any, labels: np.ndarray, geoms: tuple[str, ...]) -> np.ndarray:
    """Return the number of pixels, [N] int, that show any of the named geoms, for segmentations ``labels`` [N, H, W]."""
    return np.isin(labels, [env.mj_model.geom(name).id for name in geoms]).sum(axis=(1, 2))


def compare_pairs(goals: Goals, threshold: float) -> tuple[int, int, int, tuple[int, int]]:
    """Compare pairs of goals that are more than a threshold apart.

    Returns:
        Number of pairs with identical images, number of pairs up to `_NEAR` thresholds apart, the minimum number of bytes in
        which the images of the latter differ, and the indices of that pair; -1 without such pairs.
    """
    distance = np.linalg.norm(goals.states[:, None] - goals.states[None], axis=-1)
    flat = goals.images.reshape(len(goals.images), -1)
    kinds = np.unique(flat, axis=0, return_inverse=True)[1].reshape(-1)
    apart = np.triu(distance > threshold, 1)
    identical = int(np.sum(apart & (kinds[:, None] == kinds[None])))
    first, second = np.nonzero(apart & (distance <= _NEAR * threshold))
    differences = np.array([np.count_nonzero(flat[i] != flat[j]) for i, j in zip(first, second, strict=True)])
    if not len(differences):
        return identical, 0, -1, (-1, -1)
    nearest = int(np.argmin(differences))
    return identical, len(differences), int(differences[nearest]), (int(first[nearest]), int(second[nearest]))


def report(name: str, count: int, size: int) -> bool:
    """Print the results of a task; return True if no distinct goals have identical images and no required part is occluded.

    Args:
        name: Name of the visual task.
        count: Number of goals.
        size: Height and width of the images, pixels.
    """
    env: Any = jaxrl_vis_envs.make(name, image_size=size, pixels="rgbd")
    goals = draw_goals(env, count)
    identical, near, nearest, pair = compare_pairs(goals, env.threshold)
    print(f"{name}: {count} goals at {size}x{size}, {len(goals.images[0])} channels")
    print(f"  identical images of goals more than {env.threshold:g} {env.distance_unit} apart: {identical} pairs")
    span = f"{env.threshold:g} to {_NEAR * env.threshold:g} {env.distance_unit}"
    shown = f"{nearest} bytes differ (goals {pair[0]} and {pair[1]})" if near else "none"
    print(f"  nearest images of {near} pairs {span} apart: {shown}")
    good = identical == 0
    for part, geoms in PARTS.get(name, {}).items():
        pixels = visible_pixels(env, goals.labels, geoms)
        hidden = int(np.sum(pixels == 0))
        good &= hidden == 0
        figures = f"at least {pixels.min():4d} pixels, median {int(np.median(pixels)):4d}"
        print(f"  {part:<12} {figures}, hidden in {hidden} goals")
    sys.stdout.flush()
    return good


def main(arguments: list[str] | None = None) -> int:
    """Print the results of each task; return 1 if one fails, else 0."""
    parser = argparse.ArgumentParser(description="Visible parts of goal images, and distinct goals with identical ones.")
    parser.add_argument("env", nargs="*", default=sorted(PARTS), help=f"any of {', '.join(sorted(PARTS))}; default: all")
    parser.add_argument("--goals", type=int, default=1000)
    parser.add_argument("--image-size", type=int, default=100)
    options = parser.parse_args(arguments)
    passed = [report(name, options.goals, options.image_size) for name in options.env]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
