"""Learners as pure functions of arrays: `train_step` composes an iteration of rollouts and evaluations (`acting`), replay and
sampling (`memory`), algorithms (`ddpg`, `td3`, `contrastive`), networks and auxiliary tasks.
"""
