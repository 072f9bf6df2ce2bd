"""Peers: other renderers, physics and learners, measured in the same call as ours.

    python -m benchmarks.peers.mujoco       MuJoCo's own renderer (OpenGL) on the poses of `bench render --scene`
    python -m benchmarks.peers.warp         MuJoCo Warp's renderer on the same poses
    python -m benchmarks.peers.playground   FingerTurn of MuJoCo Playground compared with ours
    python -m benchmarks.peers.torch        the same gradient steps in PyTorch
    python -m benchmarks.peers.torchjd      loss weightings compared with TorchJD's: equality and cost
    python -m benchmarks.peers.agents       agents of Stable-Baselines3 and brax on our tasks, through the adapters

Each of the first four stores both records like `jaxrl-vis bench`. The renderers and the learner in PyTorch are first checked
for agreement with ours.
"""
