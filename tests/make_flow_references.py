"""Generate tests/data/optical_flow.npz: consecutive frames of our tasks, and OpenCV's optical flow between them.

Needs opencv-python-headless; the tests that compare with the file do not. Run from the repository root:

    PYTHONPATH=.:envs python tests/make_flow_references.py

For every task and image size the file holds, under ``TASK/SIZE``:

    grey     [episodes, frames, H, W] uint8, luminance of frames one control step apart, under random actions
    flow     [episodes, frames - 1, H, W, 2] float16, (right, down) in pixels, of the grey frames
"""

import pathlib

import cv2
import jax
import numpy as np

import jaxrl_vis_envs

TASKS = ("VisualFetchReach", "VisualHandReach", "VisualFingerTurn")
SIZES = (64, 100)
EPISODES, FRAMES, SEED = 2, 4, 0
TARGET = pathlib.Path(__file__).parent / "data" / "optical_flow.npz"
# Pyramid scale, levels, window, iterations, neighbourhood, its deviation, flags: as in the authors' release.
SETTINGS = (0.5, 3, 15, 3, 5, 1.2, 0)


def render(task: str) -> dict[int, np.ndarray]:
    """Render frames [episodes, frames, 3, H, W] uint8 of the same episodes at every size; return them by size."""
    envs = {size: jaxrl_vis_envs.make(task, image_size=size, pixels="rgb", frame_stack=1) for size in SIZES}
    env = envs[SIZES[0]]

    def episode(key: jax.Array):
        reset_key, action_key = jax.random.split(key)

        def step(state, step_key: jax.Array):
            action = jax.random.uniform(step_key, (env.action_size,), minval=-1.0, maxval=1.0)
            state = env.advance(state, action)
            return state, state

        state = env.reset(reset_key).replace(obs=None)
        return jax.lax.scan(step, state, jax.random.split(action_key, FRAMES))[1]

    states = jaxrl_vis_envs.jit(jax.vmap(episode))(jax.random.split(jax.random.key(SEED), EPISODES))
    flat = jax.tree.map(lambda leaf: leaf.reshape(EPISODES * FRAMES, *leaf.shape[2:]), states)
    draw = {size: jaxrl_vis_envs.jit(lambda states, env=env: jax.lax.map(env.observe, states)) for size, env in envs.items()}
    return {size: np.asarray(draw[size](flat)).reshape(EPISODES, FRAMES, 3, size, size) for size in SIZES}


def flows(grey: np.ndarray) -> np.ndarray:
    """Compute OpenCV's flow [episodes, frames - 1, H, W, 2] float32 between consecutive frames [episodes, frames, H, W]."""
    pairs = [[(episode[step], episode[step + 1]) for step in range(FRAMES - 1)] for episode in grey]
    return np.array([[cv2.calcOpticalFlowFarneback(*pair, None, *SETTINGS) for pair in episode] for episode in pairs])


def main() -> None:
    """Render the frames, compute their flow, and write the file."""
    arrays = {"opencv": np.array(cv2.__version__)}
    for task in TASKS:
        for size, frames in render(task).items():
            grey = np.stack([[cv2.cvtColor(frame.transpose(1, 2, 0), cv2.COLOR_RGB2GRAY) for frame in row] for row in frames])
            flow = flows(grey)
            arrays |= {f"{task}/{size}/grey": grey, f"{task}/{size}/flow": flow.astype(np.float16)}
            strength = np.linalg.norm(flow, axis=-1)
            print(
                f"{task} at {size}: {np.mean(strength >= 0.25):.0%} of the pixels move, at most {strength.max():.1f} px",
                flush=True,
            )
    np.savez_compressed(TARGET, **arrays)
    print(f"wrote {TARGET.name}: {TARGET.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
