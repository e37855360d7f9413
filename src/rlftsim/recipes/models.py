"""From a name or a folder to a policy."""

from pathlib import Path
from typing import Literal

from rlftsim.errors import ConfigError
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import Policy

NAMED = {"constant_velocity": ConstantVelocity}


def load_policy(name: str) -> Policy:
    """A baseline by name, or a model folder as `save_pretrained` writes it (a run's folder will do).

    Raises:
        ConfigError: neither a known name nor a folder.
        CheckpointError: a folder that is damaged or holds something else.
    """
    if name in NAMED:
        return NAMED[name]()
    folder = Path(name)
    if (folder / "model" / "config.json").exists():
        folder = folder / "model"
    if not folder.is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join(NAMED)}.")
    return SmartPolicy.from_pretrained(folder).eval().requires_grad_(False)


def load_policy_or_oracle(name: str) -> Policy | Literal["oracle"]:
    """As `load_policy`; "oracle" stands for the record itself."""
    if name == "oracle":
        return "oracle"
    if name not in NAMED and not Path(name).is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join([*NAMED, 'oracle'])}.")
    return load_policy(name)
