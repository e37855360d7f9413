"""Traffic models: policies that implement `rollout.policy`, and their registry."""

SHIPPED_POLICIES = {
    "smart": "rlftsim.policies.smart.policy:SmartPolicy",
    "compact": "rlftsim.policies.smart.compact:CompactPolicy",
    "trafficbots": "rlftsim.policies.trafficbots.policy:TrafficBotsPolicy",
    "calibrated": "rlftsim.policies.calibrated.policy:CalibratedTokenPolicy",
    "calibrated-actions": "rlftsim.policies.calibrated.policy:CalibratedActionPolicy",
    "constant_velocity": "rlftsim.rollout.baselines:ConstantVelocity",
    "demo-base": "rlftsim.policies.shipped:demo_base",
    "demo-tuned": "rlftsim.policies.shipped:demo_tuned",
    "demo-fast": "rlftsim.policies.shipped:demo_fast",
    "demo-goals": "rlftsim.policies.shipped:demo_goals",
    "trafficbots-base": "rlftsim.policies.shipped:trafficbots_base",
}
"""Name -> module and attribute of each policy of this package; `registry` imports one on first use."""
