"""Image observations for environments of other libraries, measured on MuJoCo Playground's dm_control suite.

playground   the 25 tasks, with a camera each
parity       images of the wrapped tasks compared with `mujoco.Renderer`'s
speed        environment steps per second with and without images
gallery      page of start images, ours beside MuJoCo's
train        brax PPO from images
training_tasks   its tasks: CartpoleBalance, FetchReach

python -m benchmarks.pixels [TASK ...]       parity, speed and gallery
python -m benchmarks.pixels.train            training
"""
