"""Commands that use trained runs: a run folder, or the folder of a policy."""
