"""Goal relabelling (gcsl): train the goal encoder on the policy's own rollouts, relabelled with their endpoints.

Every rollout gets somewhere. Its endpoints become the goals of its agents, and the goal encoder learns to predict
what was decided: p(token | state, endpoint). Nothing else is trained, so agents without a goal go on deciding as
before, and every rollout is an example. Done before fine-tuning with a reward, it makes that begin with agents
that follow goals already.

Source: after Ghosh et al., "Learning to Reach Goals via Iterated Supervised Learning", 2021. Here it is one round: the
rollouts are goal-free ones.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from rlftsim.errors import ConfigError, check_positive
from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy, is_goal_conditioned
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.closed_loop import TargetedRollouts, predict_along
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.goals import not_conditioned
from rlftsim.training.imitation import ImitationConfig, Prediction, imitate
from rlftsim.training.run import TrainingScenarios, as_scenarios, require_trainable

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


def gcsl_finetune(
    policy: Policy, scenarios: TrainingScenarios, out: str | os.PathLike[str], config: GcslConfig, *, card: str = ""
) -> Path:
    """Train a policy's goal encoder in place; resumes where a run in `out` was stopped.

    Args:
        policy: an nn.Module that implements `TokenPolicy` and is goal-conditioned.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or no tokens or no goal encoder, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
        NotYetError: another run is at work in `out`.
    """
    scenarios = as_scenarios(scenarios)
    model = require_trainable(policy, scenarios, "gcsl", needs=("vocabulary",))
    if not is_goal_conditioned(model):
        raise ConfigError(not_conditioned(model))
    freeze_untrained(model, "goals")

    def predict_along_own_rollouts(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> Prediction:
        model.eval()  # nothing that dropout would act on is trained
        context = model.encode(batch)
        seed = derive_seed(config.seed, "rollouts", update)
        rollouts = simulate(model, batch, num_rollouts=config.num_rollouts, seed=seed, context=context, may_be_nan=True)
        # Autocast keeps weights that it has cast, and those cast in the rollout have no gradient.
        torch.clear_autocast_cache()
        relabelled = relabel_with_endpoints(rollouts)
        class_id = class_of_type(batch.object_type)
        # The targets are the decisions themselves, which were sampled without goals.
        targeted = TargetedRollouts(relabelled, rollouts.decision, rollouts.decision_mask, class_id)
        return predict_along(model, context, targeted, trained)

    return imitate(model, scenarios, out, config, predict_along_own_rollouts, title="goals", card=card)


def relabel_with_endpoints(rollouts: Rollouts) -> Rollouts:
    """The same rollouts, with each agent's final position as its goal."""
    # Agents that decide nothing are padding and have no endpoint.
    decides = rollouts.decision_mask.any(-1)  # [B, N, A]
    return replace(rollouts, goals=Goals(rollouts.position[..., -1, :], decides))
