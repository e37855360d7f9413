"""Settings of closed-loop fine-tuning with rewards."""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

from rlftsim.errors import ConfigError, check_finiteness, check_not_negative, check_positive, check_types
from rlftsim.realism import metric_by_name
from rlftsim.rewards import CreditTo, parse_reward, write_reward
from rlftsim.rewards.goal import goal_terms
from rlftsim.training.alarms import AlarmConfig
from rlftsim.training.freezing import TrainedModules
from rlftsim.training.goals import GoalConfig
from rlftsim.training.parallel import DeviceConfig
from rlftsim.training.reference import KlConfig
from rlftsim.training.validation import ValidationConfig

Reduction = Literal["mean", "sum"]


@dataclass(frozen=True)
class FinetuneConfig:
    """Closed-loop fine-tuning with rewards. The defaults are the paper's hyper-parameters."""

    epochs: float = 1.0
    """Passes over the training scenarios."""
    batch_size: int = 8
    """Scenarios per update, over all processes (B)."""
    num_rollouts: int = 4
    """Rollouts per scenario and update (N)."""
    micro_batch_size: int = 8
    """Scenarios in memory at once, on each GPU or in all processes on a CPU together; fewer need less memory, the
    update is the same."""
    rollouts_per_pass: int = 4
    """Rollouts of each that are scored with gradient at once; fewer need less memory, the update is the same."""
    reward: str = "mloo"
    """A registered reward, or a sum such as "mloo + 0.1*collision_offroad"; options get their defaults filled in."""
    metric: str = "2025"
    """Configuration of the meta-metric the reward is made of."""
    credit: CreditTo = "rollout"
    """Credit assignment: a reward weighs all decisions of its rollout alike, or each agent's by the agent's part."""
    credit_mixing: float = 0.1
    """With credit by agent: weight of what the other agents earned, in [0, 1]."""
    learning_rate: float = 3e-6
    """Of Adam, after the warm-up."""
    warmup_updates: int = 100
    """The learning rate rises linearly over them and is constant from then on."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay rates of Adam's moments."""
    weight_decay: float = 0.01
    """Decoupled, as in AdamW."""
    gradient_clip: float = 1.0
    """Largest norm of the gradient."""
    entropy_bonus: float = 0.0
    """Weight of the policy's entropy in the objective."""
    imitation_weight: float = 0.0
    """Weight of the pre-training loss on the same scenarios in the objective: it holds speeds and kinematics near the
    log while realism rises. A loss with noise of its own (TrafficBots) draws it for each piece in memory, so that this
    part of an update depends on `micro_batch_size`. 0 = the paper's objective."""
    hold_speed: bool = False
    """Take out of the rewards what an agent's mean speed explains, so that driving slowly (or fast) earns nothing by
    itself. Not with goals, which ask for a speed. False = the paper's objective."""
    log_prob_reduction: Reduction = "mean"
    """Over agents and decisions. The mean makes the size of an update independent of the number of agents."""
    trained: TrainedModules = "decoder"
    """The parts a policy names for fine-tuning, its last layers, its goal encoder, or everything."""
    kl: KlConfig = field(default_factory=KlConfig)
    max_kl: float = 5.0
    """Nats per decision; an update that exceeds it, or is not finite, is skipped."""
    max_skipped_in_a_row: int = 5
    """After so many skipped updates the run stops with its last good checkpoint."""
    goals: GoalConfig = field(default_factory=GoalConfig)
    alarms: AlarmConfig = field(default_factory=AlarmConfig)
    validation: ValidationConfig = field(default_factory=partial(ValidationConfig, keep_best=True))
    checkpoint_every: int = 50
    """Updates."""
    seed: int = 0
    """Of everything that is random in the run."""
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        check_types(self)
        if self.num_rollouts < 2:
            raise ConfigError(
                f"MLOO needs at least 2 rollouts per scenario, got {self.num_rollouts}: set finetune.num_rollouts >= 2."
            )
        sizes = ("batch_size", "micro_batch_size", "rollouts_per_pass", "checkpoint_every", "max_skipped_in_a_row")
        check_positive(self, ("epochs", "learning_rate", "gradient_clip", "max_kl", *sizes))
        check_not_negative(self, ("warmup_updates", "weight_decay", "imitation_weight"))
        check_finiteness(self, ("epochs", "learning_rate", "weight_decay", "entropy_bonus", "imitation_weight"))
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas are decay rates in [0, 1), got {self.betas}.")
        if not 0 <= self.credit_mixing <= 1:
            raise ConfigError(f"credit_mixing is a weight in [0, 1], got {self.credit_mixing}.")
        metric_by_name(self.metric)
        # Stored in one spelling, so that a run with the same reward written otherwise resumes.
        object.__setattr__(self, "reward", write_reward(parse_reward(self.reward)))
        depends_on_goals = bool(goal_terms(parse_reward(self.reward)))
        if depends_on_goals and not self.goals.probability:
            raise ConfigError(f"reward {self.reward!r} needs goals: set finetune.goals.probability above 0, such as 1.")
        if self.hold_speed and depends_on_goals:
            raise ConfigError(
                f"finetune.hold_speed would take the speed out of reward {self.reward!r} that goals ask for: set "
                "finetune.hold_speed to false."
            )
        if self.goals.hindsight and not depends_on_goals:
            raise ConfigError(
                f"goals.hindsight has no effect with reward {self.reward!r}: add a term, such as 0.1*goal."
            )

    def num_updates(self, num_scenarios: int) -> int:
        """Optimizer steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)
