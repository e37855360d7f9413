"""The policy that a method of fine-tuning trains, which for calibration gets features first."""

from typing import Any

from rlftsim.policies.calibrated.policy import CalibratedPolicy
from rlftsim.training.calibrate import CalibrateConfig
from rlftsim.training.methods import FinetuningConfig


def prepare_policy(policy: Any, config: FinetuningConfig) -> Any:
    """Policy with the features of a calibration, their weights 0; the policy itself for other methods.

    Args:
        policy: Base model. One that has been calibrated with the same features goes on from its weights.
        config: Settings of the method.

    Raises:
        ConfigError: The policy has no vocabulary or no weights, or a feature is unknown.
    """
    if not isinstance(config, CalibrateConfig):
        return policy
    if isinstance(policy, CalibratedPolicy) and policy.features == config.features:
        return policy
    return CalibratedPolicy(policy, config.features)
