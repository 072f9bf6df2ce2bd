"""Render a robot under a trained policy beside its observation and its goal image, as docs/images/reach.gif and push.gif show.

python docs/tools/policy_gif.py RUN_DIR OUT [--episodes 3]

The policy observes images of the size of its run; the large images show the same states from the same camera. An episode is
shown until the goal has been reached for `RESTED` steps.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

import jaxrl_vis
import jaxrl_vis_envs
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.report.videos import write_images
from jaxrl_vis.run.storage.folder import read_config
from jaxrl_vis.run.trained import shipped

SIZE, MARGIN, CAPTION = 200, 8, 16
SECONDS, LAST_SECONDS = 0.06, 1.0
RESTED = 5


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


def last_image(planes: jax.Array, channels: int) -> np.ndarray:
    """Return the newest image of stacked planes [C, H, W] as [H, W, 3], or its depth [H, W] if it has no colours."""
    image = np.asarray(planes)[-channels:]
    return image[-1] if channels == 1 else np.moveaxis(image[:3], 0, -1)


def main() -> None:
    """Roll out episodes and write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=3)
    options = parser.parse_args()
    policy = jaxrl_vis.load_policy(options.run_dir)
    config = read_config(shipped.find(options.run_dir))
    env, channels = policy.env, {"rgbd": 4, "rgb": 3, "depth": 1}[config.environment.pixels]
    large = make_env(config.replace(image_size=SIZE, pixels="rgb"))
    reset, step, draw = (jaxrl_vis_envs.jit(function) for function in (env.reset, env.step, large.observe))
    draw_goal = jaxrl_vis_envs.jit(lambda key: large.reset(key).obs["desired_goal"])
    caption = "what it observes" + (" (depth)" if channels == 1 else "")
    images, seconds = [], []
    for key in jax.random.split(jax.random.key(1), options.episodes):
        state, goal, rested = reset(key), last_image(draw_goal(key), 3), 0
        for _ in range(env.horizon):
            observed = last_image(state.obs["observation"], channels)
            images.append(compose({"robot": last_image(draw(state), 3), caption: observed, "goal image": goal}))
            seconds.append(SECONDS)
            rested = rested + 1 if float(state.metrics["success"]) else 0
            if rested > RESTED:
                break
            state = step(state, policy(state.obs["observation"], state.obs["desired_goal"]))
        seconds[-1] = LAST_SECONDS
    write_images(images, seconds, options.out, SECONDS)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB, {len(images)} frames")


if __name__ == "__main__":
    main()
