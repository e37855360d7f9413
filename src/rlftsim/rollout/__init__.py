"""What may happen: the closed loop, the policy interface and policies without weights."""
