"""Goal relabelling (gcsl): train the goal encoder on the policy's own rollouts, relabelled with endpoints.

Every rollout gets somewhere. The endpoints become the goals of the agents, and the goal encoder learns to predict the
decisions: p(token | state, endpoint). No other weights are trained, so agents without a goal go on deciding as before,
and every rollout is an example. Fine-tuning with a reward that starts from a relabelled policy begins with agents that
follow goals already.

Source: after Ghosh et al., "Learning to Reach Goals via Iterated Supervised Learning", 2021. Here the method is a
single round, with goal-free rollouts.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from rlftsim.errors import ConfigError, check_positive
from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import is_goal_conditioned
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.closed_loop import TargetedRollouts, predict_targets
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.goals import not_conditioned
from rlftsim.training.imitation import ImitationConfig, ImitationMethod, Imitator, Prediction
from rlftsim.training.method import check_trainable
from rlftsim.training.parallel import Fabric

NOT_VALIDATED = "goal-free behavior does not change here. See what was learned by `rlftsim evaluate --goals logged`."


@dataclass(frozen=True)
class GcslConfig(ImitationConfig):
    """Training of the goal encoder on relabelled rollouts."""

    epochs: float = 1.0
    batch_size: int = 8
    micro_batch_size: int = 2
    num_rollouts: int = 4
    """Of each scenario in an update."""
    learning_rate: float = 3e-3
    final_lr_ratio: float = 0.05
    gradient_clip: float = 1.0
    label_smoothing: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, ("num_rollouts",))
        if self.validation.every:
            raise ConfigError(f"gcsl.validation has no effect: {NOT_VALIDATED}")
        if self.goal_learning_rate_scale != 1.0:
            raise ConfigError(
                "gcsl.goal_learning_rate_scale has no effect, nothing else is trained: set gcsl.learning_rate."
            )


class GcslMethod(ImitationMethod[GcslConfig]):
    """Training of a policy's goal encoder ("gcsl")."""

    settings = GcslConfig
    title = "goals"
    validates = False

    def describe(self, settings: GcslConfig) -> str:
        """Origin of the examples."""
        return "own rollouts, relabelled"

    def start(self, policy: Any, scenarios: Scenarios, settings: GcslConfig, fabric: Fabric) -> Imitator:
        """Learner of the goal encoder of a `TokenPolicy`."""
        check_trainable(policy, scenarios, "gcsl", needs=("vocabulary",))
        if not is_goal_conditioned(policy):
            raise ConfigError(not_conditioned(policy))
        freeze_untrained(policy, "goals")
        return super().start(policy, scenarios, settings, fabric)

    def predict(self, learner: Imitator, batch: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predictions along the policy's rollouts, with endpoints as goals."""
        model, config = learner.policy, learner.config
        model.eval()  # nothing that dropout would act on is trained
        context = model.encode(batch)
        seed = derive_seed(config.seed, "rollouts", learner.update)
        rollouts = simulate(model, batch, num_rollouts=config.num_rollouts, seed=seed, context=context, may_be_nan=True)
        # Autocast keeps weights that it has cast, and those cast in the rollout have no gradient.
        torch.clear_autocast_cache()
        relabelled = relabel_with_endpoints(rollouts)
        class_id = class_of_type(batch.object_type)
        # The targets are the decisions themselves, which were sampled without goals.
        targeted = TargetedRollouts(relabelled, rollouts.decision, rollouts.decision_mask, class_id)
        return predict_targets(model, context, targeted, trained)


def relabel_with_endpoints(rollouts: Rollouts) -> Rollouts:
    """The same rollouts, with each agent's final position as the goal."""
    # Agents that decide nothing are padding and have no endpoint.
    decides = rollouts.decision_mask.any(-1)  # [B, N, A]
    return replace(rollouts, goals=Goals(rollouts.position[..., -1, :], decides))
