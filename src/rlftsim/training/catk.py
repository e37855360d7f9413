"""CAT-K ("closest among top-K") and RoaD ("rollouts as demonstrations"): learning along rollouts near the log.

In a CAT-K rollout each agent takes, among its K most likely tokens, the one that leads nearest to its next logged
state; where that is not valid, its most likely token. The loss is the cross-entropy of the token that leads
nearest of the whole vocabulary, from the state that the rollout has reached.

In a RoaD rollout each agent takes, among K tokens sampled from the policy, the one that leads nearest to its next
logged state. The loss is the cross-entropy of the tokens of the rollout itself: CAT-K teaches to come back to the log
at once, RoaD teaches those of the policy's own decisions that led near it. The rollouts of an epoch are those of the
policy at its start.

Sources: Zhang et al., "Closed-Loop Supervised Fine-Tuning of Tokenized Traffic Models", 2025; Garcia-Cobo et al.,
"RoaD: Rollouts as Demonstrations for Closed-Loop Supervised Fine-Tuning of Autonomous Driving Policies", 2025
(arXiv 2512.01993).
"""

import copy
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from rlftsim.errors import ConfigError, check_positive, given
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.catk_rollouts import DEFAULT_NUM_CANDIDATES, Choice, Targets, roll_out_closest
from rlftsim.training.closed_loop import predict_along
from rlftsim.training.freezing import TrainedParts, freeze_untrained
from rlftsim.training.goals import GoalConfig, choose_goals, refuse_goals
from rlftsim.training.imitation import ImitationConfig, Prediction, imitate
from rlftsim.training.run import TrainingScenarios, as_scenarios, require_trainable


@dataclass(frozen=True)
class CatkConfig(ImitationConfig):
    """Fine-tuning with CAT-K. The defaults are the published ones for SMART-tiny on WOMD, but for the epochs:
    its file says 32, RLFTSim finds the optimum between a quarter and one."""

    epochs: float = 1.0
    learning_rate: float = 5e-5
    final_lr_ratio: float = 0.05
    label_smoothing: float = 0.0
    num_candidates: int = DEFAULT_NUM_CANDIDATES
    """K."""
    choice: Choice = "closest"
    """Choice of the rollouts: closest among the K most likely, top_k sampled from them, trajeglish sampled from the K
    nearest, sampled the closest of K samples."""
    targets: Targets = "nearest"
    """Tokens to learn along the rollouts: the nearest to the log, or the ones taken."""
    rollouts_of: Literal["update", "epoch"] = "update"
    """Policy that rolls out: the present one, or as it was when the epoch began."""
    max_distance_lengths: float | None = None
    """A decision from farther off the log than so many lengths of its class's box does not count. None = all count."""
    trained: TrainedParts = "decoder"
    """The parts a policy names for fine-tuning, its last layers, its goal encoder, or everything."""
    goal_probability: float = 0.0
    """Probability of an agent to have its logged endpoint as a goal; for a goal-conditioned policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, ("num_candidates", *given(self, ("max_distance_lengths",))))
        if not 0 <= self.goal_probability <= 1:
            raise ConfigError(f"goal_probability is a probability in [0, 1], got {self.goal_probability}.")


@dataclass(frozen=True)
class RoadConfig(CatkConfig):
    """Fine-tuning with RoaD: CAT-K's settings with RoaD's rollouts and targets."""

    num_candidates: int = 64
    choice: Choice = "sampled"
    targets: Targets = "taken"
    rollouts_of: Literal["update", "epoch"] = "epoch"


def catk_finetune(
    policy: Policy,
    scenarios: TrainingScenarios,
    out: str | os.PathLike[str],
    config: CatkConfig,
    *,
    held_out: TrainingScenarios | None = None,
    card: str = "",
) -> Path:
    """Fine-tune a policy in place with CAT-K; resumes where a run in `out` was stopped.

    A batch is encoded once, with gradient. Its rollout (dropout active, no gradient) and the pass that scores its
    targets share that context; the scoring pass draws a dropout of its own.

    Args:
        policy: an nn.Module that implements `TokenPolicy`.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: see its fields.
        held_out: scenarios to validate on, see `config.validation`; None = no validation.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or no tokens, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
        NotYetError: another run is at work in `out`.
    """
    scenarios = as_scenarios(scenarios)
    method = "RoaD" if isinstance(config, RoadConfig) else "CAT-K"
    model = require_trainable(policy, scenarios, method, needs=("vocabulary",))
    refuse_goals(model, config.goal_probability)
    freeze_untrained(model, config.trained)
    goal_config = GoalConfig(probability=config.goal_probability)
    # Without dropout, as a policy that simulates.
    frozen = copy.deepcopy(model).eval().requires_grad_(False) if config.rollouts_of == "epoch" else None

    def predict_along_catk(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> Prediction:
        context = rollout_context = model.encode(batch)
        behavior = model
        if frozen is not None:
            before, now = (places * config.batch_size // len(scenarios) for places in (update - 1, update))
            if now > before:
                frozen.to(batch.device).load_state_dict(model.state_dict())
            behavior, rollout_context = frozen, frozen.encode(batch)
        goals = choose_goals(batch, goal_config, None, seed=derive_seed(config.seed, "goals", update))
        targeted = roll_out_closest(
            behavior, batch, num_candidates=config.num_candidates, choice=config.choice, targets=config.targets,
            context=rollout_context, goals=goals, max_distance_lengths=config.max_distance_lengths,
            seed=derive_seed(config.seed, "rollouts", update),
        )  # fmt: skip
        # Autocast keeps weights that it has cast, and those cast in the rollout have no gradient.
        torch.clear_autocast_cache()
        return predict_along(model, context, targeted, trained)

    return imitate(
        model, scenarios, out, config, predict_along_catk,
        title=method, card=card, held_out=None if held_out is None else as_scenarios(held_out),
        kept={} if frozen is None else {"frozen": frozen},
    )  # fmt: skip
