"""Commands on what a run has left: its folder, or the folder of a policy."""
