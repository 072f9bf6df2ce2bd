"""Use of a trained run: restoring, policies, results."""
