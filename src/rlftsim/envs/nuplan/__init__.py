"""nuPlan's closed loop with traffic of this package: `agents`, and a folder of hydra settings for it."""
