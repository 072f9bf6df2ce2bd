"""Pure functions of arrays, in the order in which data passes through: rollout, replay, sampling, ddpg, train_step, evaluate."""
