"""TrafficBots models, each with the numbers of the training."""

from collections.abc import Collection
from dataclasses import dataclass, field

import torch

from rlftsim.errors import ConfigError
from rlftsim.policies.checkpoint import load_strictly
from rlftsim.policies.trafficbots.config import TrafficBotsConfig, trafficbots_demo
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.recipes.base import Recipe
from rlftsim.rollout.policy import Policy
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import CalibrateConfig, CatkConfig, FinetuneConfig, GcslConfig, KlConfig, PretrainConfig


@dataclass(frozen=True, kw_only=True)
class TrafficBotsRecipe(Recipe):
    """All settings from fresh weights to the fine-tuned TrafficBots policy, which has neither tokens nor goals."""

    model_name, policy_type = "TrafficBots V1.5", TrafficBotsPolicy
    model: TrafficBotsConfig = field(default_factory=TrafficBotsConfig)
    catk: CatkConfig | None = None
    gcsl: GcslConfig | None = None
    calibrate: CalibrateConfig | None = field(default_factory=CalibrateConfig)

    @property
    def counterpart(self) -> str:
        """SMART, in the small size for small TrafficBots models."""
        return "smart-tiny" if self.model.dim >= 128 else "synthetic"

    def new_policy(self, vocabulary: Vocabulary | None) -> TrafficBotsPolicy:
        """A TrafficBots policy with fresh weights, drawn with the seed of pre-training.

        Raises:
            ConfigError: A vocabulary, which no TrafficBots model uses.
        """
        if vocabulary is not None:
            raise ConfigError("a TrafficBots model has no vocabulary: leave --vocabulary out.")
        torch.manual_seed(self.pretrain.seed)
        return TrafficBotsPolicy(self.model)

    def train_further(
        self, policy: Policy, vocabulary: Vocabulary | None = None, keep: Collection[str] = ()
    ) -> TrafficBotsPolicy:
        """A policy with the sizes of this recipe and the weights of an existing policy.

        Args:
            policy: Existing TrafficBots policy; training starts from the weights.
            vocabulary: None, since the model has no tokens; a vocabulary is refused.
            keep: Classes that would keep the tokens; without effect here.

        Raises:
            CheckpointError: the weights are of other sizes.
            ConfigError: A vocabulary, which no TrafficBots model uses.
        """
        assert isinstance(policy, TrafficBotsPolicy)
        further = self.new_policy(vocabulary)
        load_strictly(further, policy.state_dict(), source="the model to train further")
        return further


def trafficbots_v15_rlftsim() -> TrafficBotsRecipe:
    """The paper: TrafficBots V1.5 (7.9 M), pre-trained on WOMD for 1 epoch, fine-tuned for 12 000 updates."""
    return TrafficBotsRecipe(
        pretrain=PretrainConfig(
            epochs=1.0, batch_size=8, micro_batch_size=2, learning_rate=2e-4, final_lr_ratio=1.0, betas=(0.9, 0.95),
            weight_decay=0.1, gradient_clip=5.0, label_smoothing=0.0, context_radius_m=None,
            trained_radius_m=1000.0, max_trained_agents=None, checkpoint_every=500,
        ),
        finetune=FinetuneConfig(epochs=0.197, micro_batch_size=2, rollouts_per_pass=2),
    )  # fmt: skip


def trafficbots_demo_rlftsim() -> TrafficBotsRecipe:
    """A small model for two CPU cores and a few hundred scenarios: many small updates, large steps."""
    return TrafficBotsRecipe(
        method="calibrate",
        model=trafficbots_demo(),
        pretrain=PretrainConfig(
            epochs=10.0, batch_size=2, micro_batch_size=2, learning_rate=1e-3, warmup_updates=40, final_lr_ratio=0.0,
            betas=(0.9, 0.95), weight_decay=0.1, gradient_clip=5.0, label_smoothing=0.0, context_radius_m=None,
            trained_radius_m=1000.0, max_trained_agents=None, ema_decay=0.99, checkpoint_every=100,
        ),
        finetune=FinetuneConfig(
            epochs=2.4, batch_size=4, micro_batch_size=1, num_rollouts=8, rollouts_per_pass=8, credit="agent",
            constraints=("moving_speed", "evaluated_moving_speed"), trained="head", learning_rate=6e-3,
            warmup_updates=5, checkpoint_every=16, kl=KlConfig(target=0.05, initial_beta=0.01),
        ),
    )  # fmt: skip
