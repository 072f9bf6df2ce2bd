"""Deep deterministic policy gradient with goals, its losses, its optimiser and what it logs."""
