"""Models that ship with the package, CC0, loaded by name: `load_policy("demo-base")`.

The weights are stored in float16 and computed with in float32. A README in each folder has the training data and the
scores of a model.
"""

from rlftsim.jobs.arrays import read_tensors
from rlftsim.policies.calibrated.policy import CALIBRATION, CalibratedTokenPolicy, read_calibration
from rlftsim.policies.checkpoint import SHIPPED_MODELS, load_strictly
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy


def demo_base() -> SmartPolicy:
    """SMART of the demo's size, pre-trained on synthetic scenarios and not fine-tuned."""
    return SmartPolicy.from_pretrained(SHIPPED_MODELS / "demo-base")


def demo_tuned() -> CalibratedTokenPolicy:
    """demo-base after MLOO that holds speed and a calibration: half of the collisions, at the same driving speed."""
    calibration = read_calibration(SHIPPED_MODELS / "demo-tuned" / CALIBRATION)
    features, eta = zip(*((row["feature"], row["eta"]) for row in calibration["features"]))
    return CalibratedTokenPolicy(_with_changes(demo_base(), "demo-tuned"), features, eta, calibration)


def demo_fast() -> CalibratedTokenPolicy:
    """A student of demo-tuned, a seventh of the weights: rollouts in a quarter of the time, 0.009 less realistic."""
    return CalibratedTokenPolicy.from_pretrained(SHIPPED_MODELS / "demo-fast")


def demo_goals() -> SmartPolicy:
    """demo-base with a trained goal encoder: 192 weights more, and without goals the same to the last bit."""
    return _with_changes(demo_base().with_goal_conditioning("indication", logit_bias=True), "demo-goals")


def trafficbots_base() -> TrafficBotsPolicy:
    """TrafficBots V1.5 in a small size, pre-trained on synthetic scenarios and not fine-tuned."""
    return TrafficBotsPolicy.from_pretrained(SHIPPED_MODELS / "trafficbots-base")


def _with_changes(policy: SmartPolicy, name: str) -> SmartPolicy:
    """The policy with the weights that a model in the box changed, or added."""
    file = SHIPPED_MODELS / name / "changes.safetensors"
    changes, _ = read_tensors(file, "install rlftsim again")
    load_strictly(policy.network, policy.network.state_dict() | changes, source=str(file))
    return policy
