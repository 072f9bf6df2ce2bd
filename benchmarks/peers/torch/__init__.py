"""Our learner's gradient steps in PyTorch, checked against ours and then timed."""
