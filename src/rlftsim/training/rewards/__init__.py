"""One file a reward: rollouts in, one number per rollout out."""
