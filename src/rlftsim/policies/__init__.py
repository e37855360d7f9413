"""Who decides: models that implement `rollout.policy`."""
