"""Policies that Stable-Baselines3 has learned, as planners: `rlftsim drive sb3:ppo.zip`.

Such a file has pickled objects, and unpickling runs whatever code the author put there. So tensors alone are read, by
torch's restricted reader: the network is built anew from the shapes of the weights, and from the names of classes that
stand beside the pickles as text.
"""

import io
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, MultiInputActorCriticPolicy
from torch import Tensor

from rlftsim.envs.actions import MIN_HORIZON, ActionType, build_controls
from rlftsim.envs.driver_view import DriverView
from rlftsim.envs.observations import SHAPES
from rlftsim.envs.spaces import action_space, observation_space
from rlftsim.errors import ConfigError
from rlftsim.jobs.documents import first_line, parse_json

MAX_BYTES = 1 << 28
"""Most bytes that weights or settings unfold to; the network of a planner has some megabytes."""
ACTIVATIONS = ("Tanh", "ReLU", "ELU", "GELU", "SiLU", "LeakyReLU")
WAY_OUT = "load it in a file of your own with Stable-Baselines3, and name that as package.module:function"


class Sb3Planner:
    """The mean or likeliest action of a policy that PPO or A2C has learned: "MlpPolicy" on flat observations,
    or "MultiInputPolicy" with `DriverView`.

    Args:
        path: File that `model.save` wrote. The number of outputs tells the type of action.

    Raises:
        ConfigError: Missing or damaged file, or a policy of a different kind.
    """

    def __init__(self, path: str):
        try:
            weights, settings = _read_policy(Path(path))
            self.action: ActionType
            self.action, self.horizon = _find_action(weights)
            self._is_flat = "features_extractor_class" not in settings
            self._policy = self._build_policy(weights, settings)
        except FileNotFoundError:
            raise ConfigError(f"sb3:{path}: no such file: name one that model.save wrote.") from None
        except Exception as error:  # whatever damage makes of the code that reads it
            raise ConfigError(
                f"sb3:{path} is no policy of PPO or A2C with MlpPolicy, or with DriverView ({first_line(error)}): "
                f"{WAY_OUT}."
            ) from error

    def _build_policy(self, weights: dict[str, Tensor], settings: dict[str, Any]) -> ActorCriticPolicy:
        pattern = re.compile(r"mlp_extractor\.(policy|value)_net\.\d+\.weight")
        widths: dict[str, Any] = {"pi": [], "vf": []}
        for name, value in weights.items():
            if layer := pattern.fullmatch(name):
                widths["pi" if layer[1] == "policy" else "vf"].append(len(value))
        extractor = settings.get("features_extractor_class")
        if extractor not in (None, str(DriverView)):
            raise ValueError(f"features_extractor_class {extractor}")
        activation = str(settings.get("activation_fn", "torch.nn.modules.activation.Tanh'>"))
        names = [name for name in ACTIVATIONS if activation.endswith(f".{name}'>")]
        if not names:
            raise ValueError(f"activation {activation[:60]}")
        policy_class: Any = ActorCriticPolicy if self._is_flat else MultiInputActorCriticPolicy
        observations = observation_space("flat" if self._is_flat else "dict")
        actions = action_space(build_controls(self.action, horizon=self.horizon))
        options = {"net_arch": widths, "activation_fn": getattr(torch.nn, names[0])}
        options |= {} if self._is_flat else {"features_extractor_class": DriverView}
        policy = policy_class(observations, actions, lambda progress: 0.0, **options)
        policy.load_state_dict(weights)
        return policy.eval()

    def reset(self, info: dict[str, Any]) -> None:
        """A policy without memory has no use for the beginning of an episode."""

    def act(self, observation: dict[str, Any]) -> Any:
        """Mean action, inside the limits."""
        inputs: Any = observation
        if self._is_flat:
            inputs = np.concatenate([np.ravel(observation[name]) for name in SHAPES]).astype(np.float32)
        return self._policy.predict(inputs, deterministic=True)[0]


def _read_policy(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights of a policy by name, and the texts of its settings."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.getinfo(name) for name in ("policy.pth", "data")}
        if sum(entry.file_size for entry in entries.values()) > MAX_BYTES:
            raise ValueError(f"over {MAX_BYTES >> 20} MB")
        stored, text = (archive.read(name) for name in entries)
    with zipfile.ZipFile(io.BytesIO(stored)) as tensors:
        if sum(entry.file_size for entry in tensors.infolist()) > MAX_BYTES:
            raise ValueError(f"weights of over {MAX_BYTES >> 20} MB")
    weights = torch.load(io.BytesIO(stored), map_location="cpu", weights_only=True)
    settings = parse_json(text.decode(), "save it again", source=str(path), allow_nan=True).get("policy_kwargs", {})
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError("policy.pth has other values than tensors by name")
    if sum(value.numel() for value in weights.values()) > MAX_BYTES // 4:  # a small file may claim large tensors
        raise ValueError("weights larger than their file")
    if not all(value.isfinite().all() for value in weights.values()):
        raise ValueError("a weight is not finite")
    return weights, settings if isinstance(settings, dict) else {}


def _find_action(weights: dict[str, Tensor]) -> tuple[ActionType, int]:
    """Type of action with as many numbers as a policy has outputs, and the number of poses of a trajectory."""
    count = len(weights["action_net.bias"])
    if "log_std" not in weights and count == build_controls("bicycle_discrete").num_choices:
        return "bicycle_discrete", MIN_HORIZON
    if "log_std" in weights and count in (2, 3):
        return "bicycle" if count == 2 else "pose", MIN_HORIZON
    if "log_std" in weights and count % 3 == 0 and count >= 3 * MIN_HORIZON:
        return "trajectory", count // 3
    raise ValueError(f"{count} outputs are no type of action")
