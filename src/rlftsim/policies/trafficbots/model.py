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

from rlftsim.policies.checkpoint import are_frozen_alike, check_fit, load_strictly, read_model, save_model
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
        """All layers that decide actions.

        The destination predictor and the map stay unchanged: destinations are drawn once per rollout, and draws must
        not depend on trained weights. Lights stay with the map; the posterior belongs to pre-training.
        """
        network = self.network
        destination = (network.destination_map, network.destination_pose, network.add_destination)
        return network.agents, *destination, network.add_personality, network.actions

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The last layer that decides how vehicles accelerate.

        Yaw rates have so narrow a noise that rollouts hardly tell good from bad: training would be a random walk.
        """
        return (self.network.actions.acceleration[VEHICLE],)

    def shares_scene_features(self, model: nn.Module) -> bool:
        """True if map and lights have the same features in a model, without gradient in both.

        Args:
            model: Model of any class; only the same class, settings and weights give True.
        """
        return self._shares_weights(model, lambda name: name.startswith(("map.", "lights.", "light_state.")))

    def shares_agent_features(self, model: nn.Module) -> bool:
        """True if a model decides actions by the same features, without gradient in both.

        Args:
            model: Model of any class; only the same class, settings and weights give True.
        """
        return self._shares_weights(model, lambda name: not name.startswith("actions."))

    def _shares_weights(self, model: nn.Module, is_shared: Callable[[str], bool]) -> bool:
        """True if the weights of such names are frozen alike, without dropout."""
        if type(model) is not type(self) or self.config != model.config or self.training or model.training:
            return False
        weights, reference = (
            [weight for name, weight in m.network.named_parameters() if is_shared(name)] for m in (self, model)
        )
        return are_frozen_alike(weights, reference)

    def encode_scene(self, scene: Scene) -> TrafficBotsContext:
        """Features of the map, and of the lights at all decisions.

        Args:
            scene: Scene of the batch; only the history is read.
        """
        map_features = self.network.map(scene, scene.node_mask)
        light_features = self._roll_lights(scene, map_features)
        agent_context = self.network.agents.context(map_features, light_features)
        trains_actions = any(weight.requires_grad for weight in self.network.actions.parameters())
        record = Record() if trains_actions and self.shares_agent_features(self) else None
        return TrafficBotsContext(scene, map_features, light_features, agent_context, self, record)

    def _roll_lights(self, scene: Scene, map_features: Float[Tensor, "B M D"]) -> Float[Tensor, "B T L D"]:
        """Features of the lights at all 80 decisions; each next state is the most likely state.

        Lights do not see agents, so that the features are the same in all rollouts of a scene.
        """
        encoder = self.network.lights
        neighborhoods = encoder.neighborhoods(scene, map_features)
        window = scene.light_state[:, None, :, : encoder.window]  # [B, 1, L, W]
        if not scene.light_mask.any():
            return encoder(window, neighborhoods).expand(-1, FUTURE_STEPS, -1, -1)
        features = []
        for _ in range(FUTURE_STEPS):
            features.append(encoder(window, neighborhoods))
            state = self.network.next_light_logits(features[-1]).argmax(-1)
            window = torch.cat([window[..., 1:], state[..., None]], -1)
        return torch.cat(features, 1)

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors and README.md.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md; empty = a line that says that the origin is unknown.
        """
        card = card or "A TrafficBots traffic model. Origin unknown.\n"
        save_model(folder, self, asdict(self.config), card=card, weights=self.network.state_dict())

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Model of a model folder as `save_pretrained` writes, or of a run's folder, in training mode.

        Args:
            folder: Model folder, or folder of a finished run.

        Raises:
            ConfigError: There is no such folder, or the settings are contradictory.
            CheckpointError: A file is missing or damaged, the architecture is different, or keys and shapes do not fit;
                the message names the first.
        """
        stored = read_model(folder, architecture=cls.architecture)
        config, weights = stored.build(TrafficBotsConfig), stored.read_weights()
        check_fit(lambda: TrafficBotsNetwork(config), weights, source=str(stored.folder))
        policy = cls(config)
        load_strictly(policy.network, weights, source=str(stored.folder))
        return policy
