"""Goal-conditioned deep deterministic policy gradient: losses, optimiser and diagnostics."""
