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

import copy
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from rlftsim.errors import ConfigError, check_positive, given
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.catk_rollouts import DEFAULT_NUM_CANDIDATES, Choice, Targets, roll_out_closest
from rlftsim.training.closed_loop import predict_targets
from rlftsim.training.freezing import TrainedModules, freeze_untrained
from rlftsim.training.goals import GoalConfig, check_goals, choose_goals
from rlftsim.training.imitation import ImitationConfig, ImitationMethod, Imitator, Prediction
from rlftsim.training.method import check_trainable
from rlftsim.training.parallel import Fabric


@dataclass(frozen=True)
class CatkConfig(ImitationConfig):
    """Fine-tuning with CAT-K.

    The defaults are published for SMART-tiny on WOMD, but for the epochs: the published file says 32, RLFTSim finds the
    optimum between a quarter and one.
    """

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
    trained: TrainedModules = "decoder"
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
            learner.frozen = copy.deepcopy(policy).eval().requires_grad_(False)
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
