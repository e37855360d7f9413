"""CAT-K ("closest among top-K") and RoaD ("rollouts as demonstrations"): learning along rollouts near the log.

In a CAT-K rollout each agent takes, among the K most likely tokens, the token that leads nearest to the next logged
state; where that state is not valid, the most likely token. The loss is the cross-entropy of the token of the whole
vocabulary that leads nearest, from the state that the rollout has reached.

In a RoaD rollout each agent takes, among K tokens sampled from the policy, the token that leads nearest to the next
logged state. The loss is the cross-entropy of the rollout's own tokens: CAT-K teaches to come back to the log at once,
RoaD teaches the policy's own decisions that led near the log. The rollouts of an epoch are made by the policy at the
start of the epoch.

Sources: Zhang et al., "Closed-Loop Supervised Fine-Tuning of Tokenized Traffic Models", 2025; Garcia-Cobo et al.,
"RoaD: Rollouts as Demonstrations for Closed-Loop Supervised Fine-Tuning of Autonomous Driving Policies", 2025
(arXiv 2512.01993).
"""

from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import frozen_copy
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.config import CatkConfig, GoalConfig, RoadConfig
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.goals import check_goals, choose_goals
from rlftsim.training.imitation import ImitationMethod, Imitator, Prediction, predict_targets
from rlftsim.training.method import check_trainable
from rlftsim.training.parallel import Fabric


class CatkMethod(ImitationMethod[CatkConfig]):
    """CAT-K.

    A batch is encoded once, with gradient. The rollout (dropout active, no gradient) and the pass that scores the
    targets share that context, and the scoring pass draws a separate dropout.
    """

    settings = CatkConfig
    title = "CAT-K"

    def describe(self, settings: CatkConfig) -> str:
        """CAT-K and the choice of rollouts."""
        return f"CAT-K, {settings.choice}"

    def start(self, policy: Any, scenarios: Scenarios, settings: CatkConfig, fabric: Fabric) -> Imitator:
        """Learner of the trained parts of a `TokenPolicy`."""
        check_trainable(policy, scenarios, self.title, needs=("vocabulary",))
        check_goals(policy, settings.goal_probability)
        freeze_untrained(policy, settings.trained)
        learner = super().start(policy, scenarios, settings, fabric)
        if settings.rollouts_of == "epoch":  # without dropout, as a policy that simulates
            learner.frozen = frozen_copy(policy)
        return learner

    def predict(self, learner: Imitator, batch: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predictions along rollouts near the log."""
        model, config, update = learner.policy, learner.config, learner.update
        context = rollout_context = model.encode(batch)
        behavior = model
        if learner.frozen is not None:
            behavior = learner.frozen
            last, epoch = (count * config.batch_size // learner.num_scenarios for count in (update - 1, update))
            if epoch > last:
                behavior.load_state_dict(model.state_dict())
            rollout_context = behavior.encode(batch)
        goal_config = GoalConfig(probability=config.goal_probability)
        goals = choose_goals(batch, goal_config, None, seed=derive_seed(config.seed, "goals", update))
        targeted = roll_out_closest(
            behavior, batch, num_candidates=config.num_candidates, choice=config.choice, targets=config.targets,
            context=rollout_context, goals=goals, max_distance_lengths=config.max_distance_lengths,
            seed=derive_seed(config.seed, "rollouts", update),
        )  # fmt: skip
        # Autocast keeps weights that it has cast, and those cast in the rollout have no gradient.
        torch.clear_autocast_cache()
        return predict_targets(model, context, targeted, trained)


class RoadMethod(CatkMethod):
    """RoaD: CAT-K with other rollouts and targets, as the settings choose."""

    settings = RoadConfig
    title = "RoaD"

    def describe(self, settings: CatkConfig) -> str:
        """RoaD."""
        return self.title
