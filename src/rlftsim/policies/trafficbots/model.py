"""TrafficBots' weights and files.

B scenarios, A agents, L lights, M map tokens, D width.
"""

import os
from collections.abc import Callable
from dataclasses import asdict
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rlftsim.policies.checkpoint import check_fit, load_strictly, read_model, save_model
from rlftsim.policies.sharing import are_frozen_alike
from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.destinations import VEHICLE
from rlftsim.policies.trafficbots.network import TrafficBotsNetwork
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.policies.trafficbots.state import Record, TrafficBotsContext
from rlftsim.scenario.types import FUTURE_STEPS

Model = TypeVar("Model", bound="TrafficBotsModel")


class TrafficBotsModel(nn.Module):
    """TrafficBots' network; `TrafficBotsPolicy` adds the decisions."""

    architecture = "trafficbots"

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        self.config = config
        self.network = TrafficBotsNetwork(config)

    def fine_tuned_modules(self) -> tuple[nn.Module, ...]:
        """Everything that decides actions.

        The destination predictor and the map stay as they are: destinations are drawn from them once per rollout, and
        what is drawn must not depend on trained weights. Lights stay with the map; the posterior is of pre-training.
        """
        network = self.network
        destination = (network.destination_map, network.destination_pose, network.add_destination)
        return network.agents, *destination, network.add_personality, network.actions

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The last layer that decides how vehicles accelerate.

        Rollouts say next to nothing of yaw rate, whose noise is narrow: training it would be a random walk.
        """
        return (self.network.actions.acceleration[VEHICLE],)

    def sees_as(self, other: nn.Module) -> bool:
        """True if map and lights have the same features in another model, without gradient in both.

        Args:
            other: any model.
        """
        return self._shares(other, lambda name: name.startswith(("map.", "lights.", "light_state.")))

    def has_features_of(self, other: nn.Module) -> bool:
        """True if the features that actions are decided by are the same in another model, without gradient in both.

        Args:
            other: any model.
        """
        return self._shares(other, lambda name: not name.startswith("actions."))

    @property
    def trains_actions_alone(self) -> bool:
        """True if weights behind the agents' features require a gradient, and none before them."""
        return self.has_features_of(self) and any(w.requires_grad for w in self.network.actions.parameters())

    def _shares(self, other: nn.Module, belongs: Callable[[str], bool]) -> bool:
        """True if the weights of such names are frozen alike, and nothing is dropped out."""
        if type(other) is not type(self) or self.config != other.config or self.training or other.training:
            return False
        own, others = (
            [weight for name, weight in one.network.named_parameters() if belongs(name)] for one in (self, other)
        )
        return are_frozen_alike(own, others)

    def encode_scene(self, scene: Scene) -> TrafficBotsContext:
        """Features of the map, and of the lights at all decisions.

        Args:
            scene: only its history is used.
        """
        map_features = self.network.map(scene, scene.node_mask)
        light_features = self._roll_lights(scene, map_features)
        around = self.network.agents.context(map_features, light_features)
        record = Record() if self.trains_actions_alone else None
        return TrafficBotsContext(scene, map_features, light_features, around, self, record)

    def _roll_lights(self, scene: Scene, map_features: Float[Tensor, "B M D"]) -> Float[Tensor, "B T L D"]:
        """Features of the lights at all 80 decisions; each next state is the most likely one.

        Lights do not see agents, so that they are the same in all rollouts of a scene.
        """
        encoder = self.network.lights
        around = encoder.neighborhoods(scene, map_features)
        window = scene.light_state[:, None, :, : encoder.window]  # [B, 1, L, W]
        if not scene.light_mask.any():
            return encoder(window, around).expand(-1, FUTURE_STEPS, -1, -1)
        features = []
        for _ in range(FUTURE_STEPS):
            features.append(encoder(window, around))
            state = self.network.next_light_logits(features[-1]).argmax(-1)
            window = torch.cat([window[..., 1:], state[..., None]], -1)
        return torch.cat(features, 1)

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors and README.md.

        Args:
            folder: created where it is missing.
            card: text of README.md.
        """
        card = card or "A TrafficBots traffic model. Origin unknown.\n"
        save_model(folder, self, asdict(self.config), card=card, weights=self.network.state_dict())

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Model of a model folder as `save_pretrained` writes it, or of a run's folder, in training mode.

        Raises:
            ConfigError: there is no such folder, or its settings contradict each other.
            CheckpointError: a missing or damaged file, another architecture, or keys and shapes that do not fit:
                names the first.
        """
        stored = read_model(folder, architecture=cls.architecture)
        config, weights = stored.build(TrafficBotsConfig), stored.read_weights()
        check_fit(lambda: TrafficBotsNetwork(config), weights, source=str(stored.folder))
        policy = cls(config)
        load_strictly(policy.network, weights, source=str(stored.folder))
        return policy
