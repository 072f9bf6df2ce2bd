"""Acting: rollouts, in parts or whole, and evaluations."""
