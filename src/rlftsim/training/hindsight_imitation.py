"""Learning to follow goals from oneself: rollouts are drawn, and imitated by agents that are told where they led.

Every rollout shows how one place is reached, whatever was asked; told its end, a model learns which of the things it does anyway lead
there. The rollouts are those of the model as it was before: agents that are told nothing learn to go on as they did. And unlike the
record, which a model may know by heart, draws cannot be foretold without the goal. Supervised, so faster than any reward; the
hindsight of RLFTSim, section 4.2, without a policy gradient (goal-conditioned supervised learning, Ghosh et al., 2021).
"""

import copy
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_positive
from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.catk import ClosedLoopPrediction, PursuingRollouts, TokenPolicy, predict_along
from rlftsim.training.freezing import TrainedParts, freeze_untrained
from rlftsim.training.goals import choose_agents, refuse_goals
from rlftsim.training.imitation import ImitationConfig, imitate


@dataclass(frozen=True)
class HindsightConfig(ImitationConfig):
    """How a model learns to follow goals from its own rollouts."""

    epochs: float = 1.0
    learning_rate: float = 5e-5
    final_learning_rate_share: float = 0.05
    label_smoothing: float = 0.0
    context_radius_m: float | None = None
    num_rollouts: int = 8
    """Of each scenario in an update."""
    goal_share: float = 0.8
    """Chance of an agent to be told where it went."""
    trained: TrainedParts = "decoder"
    """The parts a policy names for fine-tuning, the weights that see goals, or everything."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, ("num_rollouts",))
        if not 0 < self.goal_share <= 1:
            raise ConfigError(f"goal_share is a share in (0, 1], got {self.goal_share}: without goals nothing is learned.")


def hindsight_finetune(
    policy: Policy,
    scenarios: Scenarios,
    out: Path,
    config: HindsightConfig,
    *,
    held_out: Scenarios | None = None,
    card: str = "",
) -> Path:
    """Fine-tune a policy in place along rollouts of what it was before, told where they ended; go on where a run in `out` was stopped.

    Dropout is off: what is imitated is what the policy does.

    Args:
        policy: an nn.Module that implements `TokenPolicy` and sees goals.
        scenarios: with their futures; scenarios without are refused.
        out: the run's folder.
        config: see its fields.
        held_out: scenarios to validate on, see `config.validation`; None = no validation.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or no tokens, does not see goals, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
    """
    if not isinstance(policy, nn.Module) or not isinstance(policy, TokenPolicy) or not hasattr(policy, "save_pretrained"):
        raise ConfigError(
            f"{type(policy).__name__} cannot learn from its own rollouts: it needs weights, a vocabulary of tokens and save_pretrained."
        )
    refuse_goals(policy, config.goal_share)
    before = copy.deepcopy(policy).requires_grad_(False).eval()
    freeze_untrained(policy, config.trained)

    def along_own_rollouts(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> ClosedLoopPrediction:
        policy.eval()
        seed = derive_seed(config.seed, "rollouts", update)
        told = choose_agents(batch, config.goal_share, seed=derive_seed(config.seed, "goals", update))
        with torch.no_grad():
            rollouts = simulate(before, batch, num_rollouts=config.num_rollouts, seed=seed)
        torch.clear_autocast_cache()  # or weights cast during the rollout, without gradient, would be used again
        return predict_along(policy, policy.encode(batch), told_where_they_went(batch, rollouts, told), trained)

    return imitate(policy, scenarios, out, config, along_own_rollouts, title="hindsight", held_out=held_out, card=card)


def told_where_they_went(batch: ScenarioBatch, rollouts: Rollouts, told: Bool[Tensor, "B A"]) -> PursuingRollouts:
    """Rollouts as if those who are told had been asked to go where they went, to be decided as they were."""
    goals = Goals(rollouts.position[..., -1, :], told[:, None].expand(rollouts.heading.shape[:3]))
    return PursuingRollouts(
        replace(rollouts, goals=goals), rollouts.decision, rollouts.decision_mask, class_of_type(batch.object_type)
    )
