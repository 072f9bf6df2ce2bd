"""Pure functions of arrays, in the order of the data: rollout, replay, sampling, ddpg, train_step, evaluate."""
