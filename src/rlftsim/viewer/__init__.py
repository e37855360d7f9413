"""Look at it: pictures and pages of scenarios and rollouts."""
