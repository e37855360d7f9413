"""Traffic models: policies that implement `rollout.policy`, and their registry."""
