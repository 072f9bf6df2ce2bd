"""Comparison of our weightings with TorchJD's, which runs in an environment of its own.

    python -m venv torchjd && torchjd/bin/pip install torch "torchjd[full]==0.18.0"
    python -m benchmarks.peers.torchjd equality --python torchjd/bin/python    same Jacobians, same results
    python -m benchmarks.peers.torchjd cost --python torchjd/bin/python        time on one device, in one call

jacobians   random Jacobians of all ranks, and the random numbers of random methods
ours, peer  results of either library; `peer` imports only PyTorch and TorchJD, and is run as a script
equality    differences, and residuals of each library's solution of the method's problem
cost        time of a step for 2 to 16 losses; `peer_cost`: TorchJD's
"""
