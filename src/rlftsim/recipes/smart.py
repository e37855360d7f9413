"""SMART models of several sizes, each with the numbers of the training. A variant calls one of these and
changes fields."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from rlftsim.errors import ConfigError
from rlftsim.policies.smart.config import SmartConfig, smart_demo, smart_mini, smart_nano, smart_tiny
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.base import Recipe
from rlftsim.rollout.policy import Policy
from rlftsim.tokens.clustering import TokensConfig
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import (
    CalibrateConfig,
    CatkConfig,
    FinetuneConfig,
    GcslConfig,
    GoalConfig,
    KlConfig,
    PretrainConfig,
    RoadConfig,
)


@dataclass(frozen=True, kw_only=True)
class SmartRecipe(Recipe):
    """All settings from the vocabulary to the fine-tuned SMART policy."""

    model_name, policy_type = "SMART", SmartPolicy
    tokens: TokensConfig = field(default_factory=TokensConfig)
    model: SmartConfig = field(default_factory=SmartConfig)
    road: RoadConfig | None = field(default_factory=RoadConfig)
    calibrate: CalibrateConfig | None = field(default_factory=CalibrateConfig)

    @property
    def counterpart(self) -> str:
        """TrafficBots, in the small size for SMART models of fewer than 128 numbers a feature."""
        return "trafficbots" if self.model.dim >= 128 else "trafficbots-demo"

    def new_policy(self, vocabulary: Vocabulary | None) -> SmartPolicy:
        """A SMART policy with fresh weights, drawn with the seed of pre-training.

        Raises:
            ConfigError: there is no vocabulary.
        """
        if vocabulary is None:
            raise ConfigError(
                "a SMART model needs a vocabulary: build one with `rlftsim tokens`, then name it with --vocabulary."
            )
        # Directly before the weights are drawn: anything random in between would change every stored result.
        torch.manual_seed(self.pretrain.seed)
        return SmartPolicy(self.model, vocabulary)

    def train_further(
        self, policy: Policy, vocabulary: Vocabulary | None = None, keep: Collection[str] = ()
    ) -> SmartPolicy:
        """A policy with the sizes of this recipe and the weights of an existing policy.

        Args:
            policy: Existing SMART policy; training starts from the weights.
            vocabulary: Tokens in place of the policy's, see `align_vocabulary`; None = no change.
            keep: Classes that stay with the policy's tokens.

        Raises:
            CheckpointError: the weights are of other sizes.
            ConfigError: More tokens than the policy can hold, or a separate head for each class.
        """
        assert isinstance(policy, SmartPolicy)
        torch.manual_seed(self.pretrain.seed)  # as for a new policy
        return policy.with_settings(self.model, vocabulary, keep)

    def with_goals(self) -> "SmartRecipe":
        """The same recipe for goal-conditioned fine-tuning; CAT-K then chooses among all tokens, not among the
        most likely ones."""
        # The goal-conditioned weights start at zero: among the most likely tokens none may lead towards the goal.
        goals = super().with_goals()
        assert isinstance(goals, SmartRecipe)
        if goals.finetune.num_scored is not None:
            goals = replace(goals, finetune=replace(_score_all(goals.finetune), imitation_weight=0.002))
        return replace(goals, catk=goals.catk and replace(goals.catk, num_candidates=goals.tokens.num_tokens))


def smart_tiny_rlftsim() -> SmartRecipe:
    """The paper: SMART-tiny (7 M), pre-trained on WOMD for 32 epochs, fine-tuned for 1."""
    return SmartRecipe(model=replace(smart_tiny(), frequency_init="log_spaced"))


def smart_mini_rlftsim() -> SmartRecipe:
    """SMART-mini (3 M)."""
    return SmartRecipe(model=replace(smart_mini(), frequency_init="log_spaced"))


def smart_nano_rlftsim() -> SmartRecipe:
    """SMART-nano (1 M): fits a small GPU."""
    return SmartRecipe(
        model=replace(smart_nano(), frequency_init="log_spaced"),
        pretrain=PretrainConfig(batch_size=16),
        catk=CatkConfig(batch_size=16),
        road=RoadConfig(batch_size=16),
    )


def smart_demo_rlftsim() -> SmartRecipe:
    """Minutes on two CPU cores, for a few hundred scenarios: a small model, many small pre-training updates,
    calibration."""
    # Few scenarios mean few updates, so steps are larger than the paper's; all agents are trained on. Averaged weights
    # and standing tokens that count less save three of ten passes. With credit by agent traffic stays nearer to the log
    # than with the paper's at the same realism, and without the last two settings of fine-tuning it gets much slower.
    near_log: dict[str, Any] = dict(
        epochs=3.0, batch_size=8, learning_rate=3e-4, warmup_updates=5, gradient_clip=1.0, max_trained_agents=None,
        checkpoint_every=20,
    )  # fmt: skip
    return SmartRecipe(
        method="calibrate",
        tokens=TokensConfig(num_tokens=1024, num_map_prototypes=256),
        model=smart_demo(),
        pretrain=PretrainConfig(
            epochs=7.0, batch_size=2, learning_rate=3e-3, warmup_updates=40, gradient_clip=1.0, label_smoothing=0.0,
            max_trained_agents=None, still_weight=0.15, ema_decay=0.99, checkpoint_every=200,
        ),
        # Many rollouts tell what a scenario's reward depends on, and the few that carry most of it are scored. Speed
        # has a price, as realism pays for slow driving and a weak model would get slow.
        finetune=FinetuneConfig(
            epochs=1.0, batch_size=4, micro_batch_size=4, num_rollouts=32, num_scored=8, rollouts_per_pass=8,
            learning_rate=3e-4, warmup_updates=5, betas=(0.5, 0.99), ema_decay=0.95, checkpoint_every=20,
            credit="agent", credit_mixing=0.0, credit_clip=3.0, log_prob_reduction="sum",
            constraints=("moving_speed", "evaluated_moving_speed", "stops"), goals=GoalConfig(learning_rate_scale=5.0),
            kl=KlConfig(target=0.02, initial_beta=1.0, horizon=1.0),
        ),
        catk=CatkConfig(**near_log),
        road=RoadConfig(**near_log),
        gcsl=GcslConfig(
            epochs=1.0, batch_size=1, num_rollouts=4, warmup_updates=10, max_trained_agents=None, checkpoint_every=80,
        ),
    )  # fmt: skip


def smart_demo_long() -> SmartRecipe:
    """The demo's model, pre-trained for half an hour of a core on thousands of scenarios; MLOO that holds speed."""
    recipe = smart_demo_rlftsim()
    assert recipe.road is not None
    return replace(
        recipe,
        # Scenarios that are seen a few times leave nothing to learn by heart, so the effort goes into reading the map:
        # moving tokens, more map tokens, and a history that is often hidden. Among parked cars the 8 nearest agents
        # of the demo do not reach the car ahead.
        model=replace(
            recipe.model, history_drop=0.2, max_agent_neighbors=24, agent_radius_m=60.0,
            max_agent_map_neighbors=64, agent_map_radius_m=50.0,
        ),
        pretrain=replace(recipe.pretrain, epochs=4.0, ema_decay=0.998, final_lr_ratio=0.0),
        road=replace(
            recipe.road, epochs=0.5, batch_size=2, learning_rate=5e-4, final_lr_ratio=0.0, warmup_updates=20,
            still_weight=0.15, ema_decay=0.99, trained="all",
        ),
        # A strong base needs smaller steps.
        finetune=replace(recipe.finetune, epochs=0.5, learning_rate=2e-4),
    )  # fmt: skip


def smart_demo_quick() -> SmartRecipe:
    """The demo's stages, each at the smallest size that is still a test."""
    recipe = smart_demo_rlftsim()
    return replace(
        recipe,
        tokens=replace(recipe.tokens, num_tokens=256, num_map_prototypes=64),
        pretrain=replace(recipe.pretrain, epochs=1.0),
        finetune=replace(recipe.finetune, epochs=0.25, num_rollouts=4, num_scored=2),
        calibrate=CalibrateConfig(num_scenarios=16, num_rollouts=4),
        catk=recipe.catk and replace(recipe.catk, epochs=0.25, batch_size=4),
        road=recipe.road and replace(recipe.road, epochs=0.25, batch_size=4),
        gcsl=recipe.gcsl and replace(recipe.gcsl, epochs=0.25),
    )


def smart_synthetic() -> SmartRecipe:
    """Experiments on the synthetic scenarios: the demo, fine-tuned with the paper's objective alone."""
    recipe = smart_demo_rlftsim()
    return replace(recipe, method="rlft", finetune=_score_all(recipe.finetune))


def _score_all(config: FinetuneConfig) -> FinetuneConfig:
    """The settings with the paper's estimator, of eight rollouts: experiments and goals were measured with it."""
    return replace(
        config, num_rollouts=8, num_scored=None, credit_mixing=0.1, credit_clip=None, log_prob_reduction="mean",
        constraints=(), kl=KlConfig(target=0.02, initial_beta=0.01), betas=(0.9, 0.999), ema_decay=None,
    )  # fmt: skip
