"""Goal-conditioned supervised learning: what a policy does anyway, told where it led.

Every rollout gets somewhere. Its agents are told so from the start, and the weights that see goals learn to predict what was decided:
which of the things that the policy might do lead there, p(token | state, end). Nothing else is trained, so a policy that is asked nothing
goes on as before, and every rollout of it is an example. It comes before fine-tuning with a reward, which so begins with agents that
know what a goal is.

Source: after Ghosh et al., Learning to Reach Goals via Iterated Supervised Learning, 2021. Here it is one round: rollouts are those of the
policy that is asked nothing, and goals their ends, as the questions will be.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_positive
from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy, sees_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.closed_loop import TargetedRollouts, TokenPolicy, predict_along
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.imitation import ImitationConfig, Prediction, imitate

NOT_VALIDATED = "what a model does when it is asked nothing does not change here. See what was learned by `rlftsim evaluate --goals recorded`."


@dataclass(frozen=True)
class GcslConfig(ImitationConfig):
    """How a policy learns what goals are."""

    epochs: float = 1.0
    batch_size: int = 8
    micro_batch_size: int = 2
    num_rollouts: int = 4
    """Of each scenario in an update."""
    learning_rate: float = 3e-3
    final_learning_rate_share: float = 0.05
    gradient_clip: float = 1.0
    label_smoothing: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, ("num_rollouts",))
        if self.validation.every:
            raise ConfigError(f"gcsl.validation has no effect: {NOT_VALIDATED}")
        if self.goal_learning_rate_scale != 1.0:
            raise ConfigError(
                "gcsl.goal_learning_rate_scale has no effect of its own, nothing else is trained: set gcsl.learning_rate."
            )


def gcsl_finetune(policy: Policy, scenarios: Scenarios, out: Path, config: GcslConfig, *, card: str = "") -> Path:
    """Teach a policy in place what goals are; go on where a run in `out` was stopped.

    Args:
        policy: an nn.Module that implements `TokenPolicy` and sees goals.
        scenarios: with their futures; scenarios without are refused.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or no tokens or sees no goals, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
    """
    if (
        not isinstance(policy, nn.Module)
        or not isinstance(policy, TokenPolicy)
        or not hasattr(policy, "save_pretrained")
    ):
        raise ConfigError(
            f"{type(policy).__name__} cannot learn from its own rollouts: it needs weights, a vocabulary of tokens and save_pretrained."
        )
    if not sees_goals(policy):
        raise ConfigError("this model does not see goals: add --goal concat or --goal indication.")
    freeze_untrained(policy, "goals")

    def along_own_rollouts(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> Prediction:
        policy.eval()  # nothing that dropout would act on is trained
        context = policy.encode(batch)
        seed = derive_seed(config.seed, "rollouts", update)
        rollouts = simulate(policy, batch, num_rollouts=config.num_rollouts, seed=seed, context=context)
        torch.clear_autocast_cache()  # or weights cast during the rollout, without gradient, would be used again
        class_id = class_of_type(batch.object_type)
        told = TargetedRollouts(told_its_ends(rollouts), rollouts.decision, rollouts.decision_mask, class_id)
        return predict_along(policy, context, told, trained)

    return imitate(policy, scenarios, out, config, along_own_rollouts, title="goals", card=card)


def told_its_ends(rollouts: Rollouts) -> Rollouts:
    """The same rollouts, each of whose agents is asked to go where it went."""
    decides = rollouts.decision_mask.any(-1)
    return replace(rollouts, goals=Goals(rollouts.position[..., -1, :], decides))
