"""Settings of every training method, their sections, and of what a method shares with others. No torch is imported.

A settings class is a frozen dataclass: a run stores it, a recipe has one for each method, and each field is a flag.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from rlftsim.errors import ConfigError, check_finiteness, check_not_negative, check_positive, check_types, given

CreditTo = Literal["rollout", "agent"]
Reduction = Literal["mean", "sum"]
TrainedModules = Literal["decoder", "head", "goals", "all"]
Choice = Literal["closest", "top_k", "trajeglish", "sampled"]
"""closest: of the K most likely tokens the one that leads nearest to the log. top_k: sampled from the K most likely.
trajeglish: sampled, by the model's probabilities, from the K that lead nearest. sampled: of K samples from the
policy the one that leads nearest. Where the next logged state is not valid: the most likely token, samples from the K
most likely ones, and with "sampled" a sample."""
Targets = Literal["nearest", "taken"]
"""nearest: the token of the whole vocabulary that leads nearest to the log. taken: the token of the rollout itself."""

GCFT = "0.9*mloo + 0.1*goal(kind='soft', partial=False)"
"""The reward "gcft" in full."""
SHIPPED_REWARDS = {"mloo": "mloo", "gcft": GCFT, GCFT: GCFT}
"""Rewards of recipes, in full. They can be read without torch, which a help text has no time to import."""
FEATURES = (
    *("speed_gap_under_2s", "speed_gap_2_to_4s", "turn_to_lane_direction", "turn_to_lane_center"),
    *("temperature_slow", "temperature_middle", "temperature_fast", "speed_slow", "speed_middle", "speed_fast"),
    *("overlap_0.5s", "overlap_1s", "edge_0.5s", "edge_1s"),
    *("overlap_0.5s_walking_cycling", "overlap_1s_walking_cycling", "edge_0.5s_walking_cycling"),
)
"""Features of this package that calibration weighs, see `policies.calibrated.features`."""
CONSTRAINED_MEANS = ("speed", "evaluated_speed", "min_ade", "kinematic")
"""Means that calibration holds, see `training.constraints`."""


def check_metric(name: str) -> None:
    """Check that there is a meta-metric of a name, and that rollouts of the closed loop have one.

    Raises:
        ConfigError: There is none, with the known names, or a metric of whole scenes.
    """
    if name != "2025":
        from rlftsim.realism import SIM_AGENTS, metric_by_name  # not at the top: it imports torch

        if metric_by_name(name).challenge != SIM_AGENTS:
            raise ConfigError(f"metric {name} scores generated scenes, and training goes on from logs: take 2025.")


def complete_reward(text: str) -> tuple[str, bool]:
    """A reward in the spelling that runs store, all options filled in; and True where it depends on goals.

    Raises:
        ConfigError: Not a sum of registered rewards.
    """
    if text in SHIPPED_REWARDS:
        return SHIPPED_REWARDS[text], SHIPPED_REWARDS[text] == GCFT
    from rlftsim.rewards import goal_terms, parse_reward, write_reward  # not at the top: it imports torch

    terms = parse_reward(text)
    return write_reward(terms), bool(goal_terms(terms))


def _check_up_to_1(config: object, group: str = "", **words: str) -> None:
    """Check that fields of a configuration are in [0, 1].

    Args:
        config: Settings with the fields.
        group: Beginning of their names in the message, such as "goals.".
        words: Words for each field, such as "a probability", by its name.

    Raises:
        ConfigError: A field is not; the message names it and its value.
    """
    for name, word in words.items():
        if not 0 <= getattr(config, name) <= 1:
            raise ConfigError(f"{group}{name} is {word} in [0, 1], got {getattr(config, name)}.")


def _check_decay(ema_decay: float | None) -> None:
    if ema_decay is not None and not 0 < ema_decay < 1:
        raise ConfigError(f"ema_decay is a fraction between 0 and 1, or None, got {ema_decay}.")


def _check_betas(betas: tuple[float, float]) -> None:
    """Check Adam's decay rates.

    Raises:
        ConfigError: A rate outside of [0, 1).
    """
    if not all(0 <= beta < 1 for beta in betas):
        raise ConfigError(f"betas are decay rates in [0, 1), got {betas}.")


@dataclass(frozen=True)
class DeviceConfig:
    """Device, processes, precision and threads of a run."""

    accelerator: Literal["auto", "cpu", "cuda"] = "auto"
    """Kind of device; auto = CUDA if there is one."""
    processes: int | Literal["auto"] = "auto"
    """Processes on this machine, that is GPUs, or cores of a CPU. auto = one on a GPU, on a CPU one for each usable
    core, but not more than scenarios in a batch or in memory at once, and one for a few scenarios. In fine-tuning more
    than scenarios divide the rollouts of each. A run stores the number in its config.json and is resumed with it:
    another one rounds otherwise. Under torchrun this and `num_nodes` have no effect: torchrun decides."""
    num_nodes: int = 1
    """Machines."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """float32, or bfloat16 where torch's autocast holds it safe."""
    threads: int = 1
    """CPU threads of each process; 0 = torch's own choice. More than one needs OMP_WAIT_POLICY=PASSIVE on shared cores.
    Rollouts always use one."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("num_nodes", *(() if self.processes == "auto" else ("processes",))))
        check_not_negative(self, ("threads",))


@dataclass(frozen=True)
class ValidationConfig:
    """Validation of a model in training."""

    every: int | Literal["auto"] = 0
    """Updates between two validations; there is one at the end, too. 0 = never. auto = so that all of a run take at
    most 5 % of its time, at the start, at the end and up to 19 times between, on at most `num_scenarios`; the best is
    kept only if on all these, and a run too short for 8 scenarios has none. A run stores the numbers in its
    config.json and is resumed with them."""
    num_scenarios: int = 64
    """A fixed random choice of the held-out scenarios; all if there are fewer."""
    num_rollouts: int = 8
    """Of each scenario. Fewer rollouts score lower: compare with an evaluation of the same number only."""
    scenarios_per_pass: int = 4
    """Simulated at once; fewer need less memory, the result is the same."""
    top_k: int | None = None
    """Sample among so many of the most likely decisions, as models trained with label smoothing need it; None = all."""
    metric: str = "2025"
    """Configuration of the meta-metric."""
    map_use: bool = True
    """Measure map use, too, which takes as long as two rollouts."""
    seed: int = 0
    """Of the choice and of the rollouts, the same at every validation."""
    paired: bool = False
    """Validate the start, too, and log the gain over it; always so with `keep_best`."""
    keep_best: bool = False
    """The model of the run is that of the best validation: of the highest lower bound (95 %, one-sided) of its gain in
    RMM over the start, scenario by scenario. As the best of several bounds it promises too much: report the gain on
    other scenarios. False = the model of the last update."""

    def __post_init__(self) -> None:
        check_types(self)
        if self.every != "auto" and self.every < 0:
            raise ConfigError(f"validation.every must be 0 (never) or more updates, or auto, got {self.every}.")
        check_positive(self, ("num_scenarios", "num_rollouts", "scenarios_per_pass", *given(self, ("top_k",))))
        check_not_negative(self, ("seed",))
        check_metric(self.metric)

    def is_due(self, update: int, total: int) -> bool:
        """True where a validation follows an update; `every` is a number.

        Args:
            update: Number of updates done.
            total: Number of updates of the run.
        """
        return self.every != "auto" and self.every > 0 and (update % self.every == 0 or update == total)

    def fit(self, num_updates: int, rollouts_per_update: int) -> "ValidationConfig":
        """The settings, with numbers in place of "auto".

        Args:
            num_updates: Number of updates of the run.
            rollouts_per_update: Rollouts that an update learns from; 1 for a scenario that is learned from its log.
        """
        if self.every != "auto":
            return self
        # a rollout costs less than 2/5 of one that is learned from, so 1/8 of all these is 5 % of the time
        affordable = num_updates * rollouts_per_update // (8 * self.num_rollouts)  # scenarios, over all validations
        num_scenarios = min(affordable // 3, self.num_scenarios)
        if num_scenarios < min(8, self.num_scenarios):
            return replace(self, every=0)
        count = min(affordable // num_scenarios, 21)  # that of the start included
        # on few scenarios the highest lower bound is that of the model that differs least from the start
        keep_best = self.keep_best and num_scenarios == self.num_scenarios
        every = math.ceil(num_updates / (count - 1))
        return replace(self, every=every, num_scenarios=num_scenarios, keep_best=keep_best)

    def choose(self, num_scenarios: int) -> list[int]:
        """Positions of the scenarios to validate on."""
        order = np.random.default_rng(self.seed).permutation(num_scenarios)
        return sorted(order[: self.num_scenarios].tolist())


@dataclass(frozen=True)
class GoalConfig:
    """Goals of the agents in training. By default there are none."""

    probability: float = 0.0
    """Probability of an agent to have a goal in an update. 1 = all agents with a logged future; between 0 and 1 (mixed
    mode) agents with and without goals meet in the same scene."""
    augmented: str | None = None
    """Folder that `rlftsim augment` wrote: goals beside the logged endpoints."""
    augmented_probability: float = 0.5
    """Probability of a scenario that has augmented goals to use them instead of the logged endpoints."""
    hindsight: float = 0.0
    """Weight of the same rollouts relabelled with goals that one of them has met; 0 = they are not used again."""
    learning_rate_scale: float = 1.0
    """Learning rate of the goal encoder, whose weights begin at zero, over that of all other weights."""

    def __post_init__(self) -> None:
        check_types(self)
        _check_up_to_1(self, "goals.", probability="a probability", augmented_probability="a probability")
        check_finiteness(self, ("hindsight", "learning_rate_scale"))
        check_not_negative(self, ("hindsight",))
        check_positive(self, ("learning_rate_scale",))
        if not self.probability and (self.augmented or self.hindsight):
            raise ConfigError(
                "goals.augmented and goals.hindsight need goals: set goals.probability above 0, such as 1."
            )


def with_goals(config: GoalConfig) -> GoalConfig:
    """The same settings, with goals for all agents and hindsight, each where off so far."""
    return replace(config, probability=config.probability or 1.0, hindsight=config.hindsight or 1.0)


@dataclass(frozen=True)
class AlarmConfig:
    """Thresholds of the alarms."""

    first_updates: int = 20
    """Updates whose mean the later ones are compared with; until then there are no alarms."""
    window: int = 20
    """Updates that a running mean covers, roughly."""
    min_ade_rise: float = 0.5
    """Fraction by which minADE may rise."""
    diversity_fall: float = 0.5
    """Fraction by which the spread of the rollouts' endpoints may fall."""
    red_light_rise: float = 0.05
    """Rise of the fraction of evaluated agents that run a red light."""
    speed_drift_mps: float = 1.0
    """Change, either way, of the mean speed against that of the log at the same steps."""
    stop: bool = False
    """The run ends with the update at which an alarm is raised; False = it goes on with a warning."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(
            self, ("first_updates", "window", "min_ade_rise", "diversity_fall", "red_light_rise", "speed_drift_mps")
        )


@dataclass(frozen=True)
class KlConfig:
    """Adaptive KL penalty (Ziegler et al., 2020), and how the reference follows the policy."""

    target: float = 0.01
    """KL that the penalty is adapted to, nats per decision."""
    horizon: float = 5.0
    """Updates; the larger, the slower the penalty adapts."""
    initial_beta: float = 0.1
    """Strength of the penalty at the start."""
    min_beta: float = 1e-3
    """Lower bound of the strength."""
    max_beta: float = 1e3
    """Upper bound of the strength."""
    condition_reference: bool = True
    """With goals: the reference has the same goals as the policy. False = none, so that it stays goal-free even
    if it is goal-conditioned."""
    reference_sync_every: int = 500
    """Updates between two syncs of the reference with the policy; 0 = never."""
    reference_ema: float = 0.005
    """Alpha: weight of the policy in a sync, reference = alpha * policy + (1 - alpha) * reference."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("target", "horizon"))
        if not 0 <= self.reference_ema <= 1 or self.reference_sync_every < 0:
            raise ConfigError(f"need 0 <= kl.reference_ema <= 1 and kl.reference_sync_every >= 0, got {self}.")
        if not 0 < self.min_beta <= self.initial_beta <= self.max_beta:
            raise ConfigError(f"need 0 < min_beta <= initial_beta <= max_beta, got {self}.")


@dataclass(frozen=True)
class FinetuneConfig:
    """Closed-loop fine-tuning with rewards. The defaults are the paper's hyper-parameters."""

    epochs: float = 1.0
    """Passes over the training scenarios."""
    batch_size: int = 8
    """Scenarios per update, over all processes (B)."""
    num_rollouts: int = 4
    """Rollouts per scenario and update (N)."""
    start_seconds: tuple[float, ...] = ()
    """Seconds that the initial model drives in long logs before the rollouts begin, each a scenario more; all of them
    before the first update, and kept in memory. 0 = the log itself; () = the first 9.1 s of the log."""
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
    credit_clip: float | None = None
    """Rewards of agents are clipped to so many standard deviations of the update's. None = the paper's estimator."""
    num_scored: int | None = None
    """Most rollouts of each scenario that are scored with gradient, drawn by how much reward they carry; scoring a
    rollout takes three times as long as simulating it. Not with hindsight. None = all, as in the paper."""
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
    ema_decay: float | None = None
    """Validate and save an exponential moving average of the weights, with this fraction of it kept at each update: a
    single update is mostly noise. None = the weights themselves, as in the paper."""
    entropy_bonus: float = 0.0
    """Weight of the policy's entropy in the objective."""
    imitation_weight: float = 0.0
    """Weight of the pre-training loss on the same scenarios in the objective: it holds speeds and kinematics near the
    log while realism rises. A loss with noise of its own (TrafficBots) draws it for each piece in memory, so that this
    part of an update depends on `micro_batch_size`. 0 = the paper's objective."""
    constraints: tuple[str, ...] = ()
    """Means that stay as the first model has them: moving_speed, evaluated_moving_speed, stops, min_ade, kinematic. A
    change has a price that grows while it lasts. Not with goals, which ask for a speed. () = the paper's objective."""
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
    validation: ValidationConfig = field(
        default_factory=partial(
            ValidationConfig, every="auto", num_rollouts=4, map_use=False, paired=True, keep_best=True
        )
    )
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
        check_positive(self, given(self, ("credit_clip", "num_scored")))
        _check_betas(self.betas)
        _check_decay(self.ema_decay)
        _check_up_to_1(self, credit_mixing="a weight")
        check_metric(self.metric)
        # Stored in one spelling, so that a run with the same reward written otherwise resumes.
        reward, depends_on_goals = complete_reward(self.reward)
        object.__setattr__(self, "reward", reward)
        if self.start_seconds and self.imitation_weight:
            raise ConfigError(
                f"finetune.imitation_weight is {self.imitation_weight:g}, but with start_seconds no log goes on where "
                "the agents are: set it to 0."
            )
        if depends_on_goals and not self.goals.probability:
            raise ConfigError(f"reward {self.reward!r} needs goals: set finetune.goals.probability above 0, such as 1.")
        if self.constraints and depends_on_goals:
            raise ConfigError(
                f"finetune.constraints would hold back the speed that goals of reward {self.reward!r} ask for: leave "
                "them out."
            )
        if self.goals.hindsight and not depends_on_goals:
            raise ConfigError(
                f"goals.hindsight has no effect with reward {self.reward!r}: add a term, such as 0.1*goal."
            )

    def num_updates(self, num_scenarios: int) -> int:
        """Optimizer steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(frozen=True)
class ImitationConfig:
    """Learning by imitation. The defaults are those of the published SMART-tiny on WOMD."""

    epochs: float = 32.0
    """Passes over the training scenarios."""
    batch_size: int = 80
    """Scenarios per update, over all processes."""
    micro_batch_size: int = 8
    """Scenarios in memory at once, at most, on each GPU or in all processes on a CPU together; gradients add up over
    the rest."""
    micro_batch_cost: float | None = None
    """Thousands of map points in memory at once, at most, an agent counted as 200: large scenarios come in
    smaller groups. Processes on a CPU share it. None = no limit."""
    learning_rate: float = 5e-4
    """At its highest, after the warm-up."""
    final_lr_ratio: float = 0.01
    """The learning rate falls along a cosine to this fraction of it."""
    warmup_updates: int = 0
    """Updates over which the learning rate rises linearly."""
    goal_learning_rate_scale: float = 1.0
    """Learning rate of the goal encoder, if there is one, over that of all other weights."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay rates of Adam's moments."""
    weight_decay: float = 0.01
    """Decoupled, as in AdamW."""
    gradient_clip: float = 0.5
    """Largest norm of the gradient."""
    label_smoothing: float = 0.1
    """Probability that the target gives to other tokens; the loss of a perfect model is then not zero. Without
    effect on a policy that brings a loss of its own."""
    label_smoothing_kind: Literal["uniform", "spatial"] = "uniform"
    """Tokens that get it: all alike, or those that lead near the right one, see `tokens.smoothing`."""
    context_radius_m: float | None = 150.0
    """A step of an agent farther from the ego than this is taken as not logged. None = everything is seen."""
    trained_radius_m: float = 100.0
    """Agents farther from the ego at the current step are context only."""
    max_trained_agents: int | None = 32
    """Of a scenario; the evaluated ones always, the rest at random. None = all."""
    mirror_probability: float = 0.0
    """Probability of a scenario to be seen mirrored, left and right exchanged: twice the scenes, but half of them with
    traffic on the other side of the road."""
    still_weight: float = 1.0
    """Weight of a prediction whose target stands still, in the loss and all metrics; others count 1. Three quarters of
    all tokens stand and few turn, so a small weight teaches more per update. The learned probability of standing is
    that of the data, whatever the weight. Needs a policy with a vocabulary."""
    ema_decay: float | None = None
    """Validate and save an exponential moving average of the weights, with this fraction of it kept at each update,
    such as 0.999. Less is kept in the first updates. None = the weights themselves."""
    max_skipped_in_a_row: int = 5
    """An update whose gradient is not finite is skipped; after so many in a row the run stops."""
    checkpoint_every: int = 200
    """Updates."""
    seed: int = 0
    """Of everything that is random in the run."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        check_types(self)
        sizes = ("batch_size", "micro_batch_size", "max_skipped_in_a_row", "checkpoint_every")
        rates = ("learning_rate", "goal_learning_rate_scale", "gradient_clip", "trained_radius_m")
        check_positive(self, ("epochs", *sizes, *rates, *given(self, ("micro_batch_cost", "context_radius_m"))))
        check_not_negative(self, ("warmup_updates", "weight_decay", *given(self, ("max_trained_agents",))))
        check_finiteness(self, ("epochs", "learning_rate", "weight_decay"))
        _check_betas(self.betas)
        _check_up_to_1(self, final_lr_ratio="a fraction", mirror_probability="a probability")
        if not 0 < self.still_weight <= 1:
            raise ConfigError(f"still_weight is a weight above 0 and at most 1, got {self.still_weight}.")
        _check_decay(self.ema_decay)
        if not 0 <= self.label_smoothing < 1:
            raise ConfigError(f"label_smoothing is a probability in [0, 1), got {self.label_smoothing}.")
        if self.label_smoothing_kind == "spatial" and not self.label_smoothing:
            raise ConfigError("label_smoothing_kind=spatial has no effect: set label_smoothing above 0, such as 0.1.")

    def num_updates(self, num_scenarios: int) -> int:
        """Optimizer steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(frozen=True)
class PretrainConfig(ImitationConfig):
    """Pre-training. The defaults, which recipes change, are those of the published SMART-tiny on WOMD."""


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
    num_candidates: int = 32
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
        _check_up_to_1(self, goal_probability="a probability")


@dataclass(frozen=True)
class RoadConfig(CatkConfig):
    """Fine-tuning with RoaD: CAT-K's settings with RoaD's rollouts and targets."""

    num_candidates: int = 64
    choice: Choice = "sampled"
    targets: Targets = "taken"
    rollouts_of: Literal["update", "epoch"] = "epoch"


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


@dataclass(frozen=True)
class DistillConfig:
    """Distillation: a student learns a teacher's distributions along rollouts."""

    epochs: float = 5.0
    """Passes over the training scenarios."""
    batch_size: int = 2
    """Scenarios per update, over all processes."""
    num_rollouts: int = 8
    """Of each scenario in an update."""
    steps_per_update: int = 8
    """Optimizer steps of an update, each on a share of the rollouts that the teacher has judged."""
    teacher_share: float = 0.25
    """Fraction of the updates along rollouts of the teacher, before the rest along the student's."""
    learning_rate: float = 3e-3
    """At its highest, after the warm-up."""
    final_lr_ratio: float = 0.0
    """The learning rate falls along a cosine to this fraction of it."""
    warmup_updates: int = 5
    """Updates over which the learning rate rises linearly."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay rates of Adam's moments."""
    weight_decay: float = 0.01
    """Decoupled, as in AdamW."""
    gradient_clip: float = 1.0
    """Largest norm of the gradient."""
    ema_decay: float | None = 0.9
    """Save a moving average of the weights, of which this fraction is kept at each update. None = the weights."""
    max_skipped_in_a_row: int = 5
    """An update whose gradient is not finite is skipped; after so many in a row the run stops."""
    checkpoint_every: int = 20
    """Updates."""
    seed: int = 0
    """Of everything that is random in the run."""
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        check_types(self)
        sizes = ("batch_size", "num_rollouts", "steps_per_update", "checkpoint_every", "max_skipped_in_a_row")
        check_positive(self, ("epochs", "learning_rate", "gradient_clip", *sizes))
        check_not_negative(self, ("warmup_updates", "weight_decay"))
        check_finiteness(self, ("epochs", "learning_rate", "weight_decay"))
        _check_betas(self.betas)
        _check_decay(self.ema_decay)
        _check_up_to_1(self, teacher_share="a fraction", final_lr_ratio="a fraction")

    @property
    def micro_batch_size(self) -> int:
        """All scenarios of an update: students are small."""
        return self.batch_size

    def num_updates(self, num_scenarios: int) -> int:
        """Updates of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(frozen=True)
class CalibrateConfig:
    """Calibration of a model: a few named features of its decisions, tokens or actions."""

    features: tuple[str, ...] = FEATURES
    """Names of the features; `rlftsim.features` is their entry-point group."""
    reward: str = "mloo"
    """A registered reward, or a sum such as "mloo + 0.1*collision_offroad", credited to agents."""
    metric: str = "2025"
    """Configuration of the meta-metric the reward is made of."""
    constraints: tuple[str, ...] = CONSTRAINED_MEANS
    """Means that the step leaves as they are, by prediction: speed, evaluated_speed, min_ade, kinematic (realism)."""
    kl: float = 0.01
    """Predicted KL of a step of length 1, nats per half second, the duration of a token."""
    lengths: tuple[float, ...] = (0.7, 1.4)
    """Lengths that are tried on the scenarios held back; the best one on a parabola through their gains is taken."""
    max_kl: float = 0.005
    """Largest measured KL of the result to the model that the run starts from, nats per half second; a longer step is
    cut. What the constraints do not see grows with its square, the gain hardly."""
    held_back: float = 0.2
    """Fraction of the scenarios that chooses the length, and not the direction."""
    num_scenarios: int = 256
    """Training scenarios that are used at most, drawn with the seed."""
    start_seconds: tuple[float, ...] = ()
    """Seconds that the initial model drives in long logs before the rollouts begin, each a scenario more; all of them
    before the first update, and kept in memory. 0 = the log itself; () = the first 9.1 s of the log."""
    num_rollouts: int = 8
    """Rollouts N of each scenario and length."""
    clip: float = 3.0
    """Rewards of agents are clipped to so many standard deviations of all until then."""
    batch_size: int = 4
    """Scenarios between two lines of metrics, over all processes."""
    micro_batch_size: int = 2
    """Scenarios in memory at once, on each GPU or in all processes on a CPU together."""
    checkpoint_every: int = 4
    """Batches between two checkpoints, from which a run that was stopped goes on."""
    seed: int = 0
    """Seed of everything that is random in the run."""
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(
            self, ("kl", "max_kl", "clip", "num_scenarios", "batch_size", "micro_batch_size", "checkpoint_every")
        )
        if self.num_rollouts < 2:
            raise ConfigError(f"credit needs at least 2 rollouts, got {self.num_rollouts}: raise num_rollouts.")
        if not 0 < self.held_back < 1:
            raise ConfigError(f"held_back is a fraction between 0 and 1, got {self.held_back}.")
        if not self.lengths or min(self.lengths) <= 0:
            raise ConfigError(f"lengths are numbers above 0, at least one, got {self.lengths}.")
        check_metric(self.metric)
        object.__setattr__(self, "reward", complete_reward(self.reward)[0])

    @property
    def warmup_updates(self) -> int:
        """0: there is no learning rate."""
        return 0

    @property
    def max_skipped_in_a_row(self) -> int:
        """1: no batch is skipped."""
        return 1

    def split_sizes(self, num_scenarios: int) -> tuple[int, int]:
        """Number of scenarios for the direction, and of scenarios held back for the length.

        Args:
            num_scenarios: Number of scenarios in the data set, at least 2.

        Raises:
            ConfigError: Fewer than two scenarios.
        """
        if num_scenarios < 2:
            raise ConfigError("calibration needs at least 2 scenarios: one for the direction and one for its length.")
        num_used = min(num_scenarios, self.num_scenarios)
        num_held_back = min(max(round(self.held_back * num_used), 1), num_used - 1)
        return num_used - num_held_back, num_held_back

    def num_updates(self, num_scenarios: int) -> int:
        """Batches of the run."""
        num_fitted, num_held_back = self.split_sizes(num_scenarios)
        batches_per_length = math.ceil(num_held_back / self.batch_size)
        return math.ceil(num_fitted / self.batch_size) + (1 + len(self.lengths)) * batches_per_length


@dataclass(frozen=True)
class AugmentConfig:
    """Sampling of augmented goals."""

    num_rollouts: int = 32
    """Rollouts of a scenario among which the most realistic is taken (N_G); the paper does not give it."""
    top_k: int | None = 32
    """Most likely decisions that are sampled among; None = all, for policies whose decisions are not categories."""
    metric: str = "2025"
    """Configuration of the meta-metric."""
    scenarios_per_part: int = 64
    """Scenarios of a file; those of a finished file are not done again."""
    seed: int = 0
    """Of the rollouts."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("num_rollouts", "scenarios_per_part", *given(self, ("top_k",))))
        check_metric(self.metric)
