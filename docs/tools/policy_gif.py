"""Render docs/images/reach.gif: the robot under a trained policy, its depth observation, and its goal image.

python docs/tools/reach_gif.py RUN_DIR [--episodes 3]

The policy observes images of the size of its run; the large images show the same states from the same camera.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

import jaxrl_vis
import jaxrl_vis_envs
from jaxrl_vis.report.videos import write_images
from jaxrl_vis.run.storage.folder import read_config

OUT = Path(__file__).resolve().parents[1] / "images" / "reach.gif"
SIZE, MARGIN, CAPTION = 200, 8, 16
SECONDS, LAST_SECONDS = 0.06, 1.0


def compose(panels: dict[str, np.ndarray]) -> Image.Image:
    """Place images side by side below their captions, enlarged to `SIZE`.

    Args:
        panels: Caption -> image [H, W] or [H, W, 3] uint8.
    """
    step = SIZE + MARGIN
    picture = Image.new("RGB", (step * len(panels) - MARGIN, SIZE + CAPTION), "white")
    draw = ImageDraw.Draw(picture)
    for place, (caption, image) in enumerate(panels.items()):
        draw.text((step * place, 2), caption, fill="black")
        enlarged = Image.fromarray(image).resize((SIZE, SIZE), Image.Resampling.NEAREST)
        picture.paste(enlarged.convert("RGB"), (step * place, CAPTION))
    return picture


def main() -> None:
    """Roll out episodes and write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=3)
    options = parser.parse_args()
    policy = jaxrl_vis.load_policy(options.run_dir)
    name = read_config(options.run_dir).environment.env
    env, large = policy.env, jaxrl_vis_envs.make(name, image_size=SIZE, pixels="rgb")
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    draw, draw_goal = jax.jit(large.observe), jax.jit(lambda key: large.reset(key).obs["desired_goal"])
    images, seconds = [], []
    for key in jax.random.split(jax.random.key(1), options.episodes):
        state, goal = reset(key), np.moveaxis(np.asarray(draw_goal(key))[-3:], 0, -1)
        for _ in range(env.horizon // 2):  # then it rests at its goal
            observed = np.asarray(state.obs["observation"])[-1]
            panels = {"robot": np.moveaxis(np.asarray(draw(state))[-3:], 0, -1), "what it observes (depth)": observed}
            images.append(compose(panels | {"goal image (it sees its depth)": goal}))
            seconds.append(SECONDS)
            state = step(state, policy(state.obs["observation"], state.obs["desired_goal"]))
        seconds[-1] = LAST_SECONDS
    write_images(images, seconds, OUT, SECONDS)
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB, {len(images)} frames")


if __name__ == "__main__":
    main()
