"""Closed-loop fine-tuning with rewards: sample, reward, score, update, sync the reference (RLFTSim, section 4).

`finetune` is the main path of this package; `update_policy` is one update of it, in seven steps.
"""

import copy
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from rlftsim.errors import ConfigError, require_finite, require_not_negative, require_positive, require_types
from rlftsim.realism import metric_by_name
from rlftsim.rewards import CreditTo, parse_reward, write_reward
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.alarms import AlarmConfig
from rlftsim.training.experience import (
    Experience,
    UpdateClock,
    compute_reward,
    count_decisions,
    describe,
    hold_speed,
    missing_rate_of,
    sample_rollouts,
)
from rlftsim.training.freezing import (
    TrainedParts,
    freeze_untrained,
    parameter_groups,
    refuse_constant_entropy,
    set_learning_rate,
    trained_parts,
)
from rlftsim.training.goals import GoalConfig, StoredGoals, refuse_goals
from rlftsim.training.hindsight import accumulate_hindsight, goal_terms
from rlftsim.training.parallel import DeviceConfig, Fabric, all_reduce_gradients, local_rollouts, num_sharing_memory
from rlftsim.training.policy_gradient import LossTerms, Reduction, accumulate_gradients
from rlftsim.training.reference import KlConfig, RewardLearner, adapt_beta, sync_reference
from rlftsim.training.run import (
    TrainingRun,
    TrainingScenarios,
    UpdateReport,
    as_scenarios,
    require_trainable,
    train_in_processes,
)


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
    trained: TrainedParts = "decoder"
    """The parts a policy names for fine-tuning, its last layers, its goal encoder, or everything."""
    kl: KlConfig = field(default_factory=KlConfig)
    max_kl: float = 5.0
    """Nats per decision; an update that exceeds it, or is not finite, is skipped."""
    max_skipped_in_a_row: int = 5
    """After so many skipped updates the run stops with its last good checkpoint."""
    goals: GoalConfig = field(default_factory=GoalConfig)
    alarms: AlarmConfig = field(default_factory=AlarmConfig)
    checkpoint_every: int = 50
    """Updates."""
    seed: int = 0
    """Of everything that is random in the run."""
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        require_types(self)
        if self.num_rollouts < 2:
            raise ConfigError(
                f"MLOO needs at least 2 rollouts per scenario, got {self.num_rollouts}: set finetune.num_rollouts >= 2."
            )
        sizes = ("batch_size", "micro_batch_size", "rollouts_per_pass", "checkpoint_every", "max_skipped_in_a_row")
        require_positive(self, ("epochs", "learning_rate", "gradient_clip", "max_kl", *sizes))
        require_not_negative(self, ("warmup_updates", "weight_decay", "imitation_weight"))
        require_finite(self, ("epochs", "learning_rate", "weight_decay", "entropy_bonus", "imitation_weight"))
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


def finetune(
    policy: Policy, scenarios: TrainingScenarios, out: str | os.PathLike[str], config: FinetuneConfig, *, card: str = ""
) -> Path:
    """Fine-tune a policy in place with rewards; resumes where a run in `out` was stopped, or ended with fewer epochs.

    Args:
        policy: an nn.Module that implements `rollout.policy.Policy` and has `save_pretrained`.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or is not goal-conditioned as the settings want, or there is no scenario.
        DataError: a scenario has no logged future or no evaluated agent.
        CheckpointError: `out` holds another run, or the run diverged (its last good checkpoint is named).
        NotYetError: another run is at work in `out`.
    """
    scenarios = as_scenarios(scenarios)
    model = require_trainable(policy, scenarios, "rewards", imitated=config.imitation_weight > 0, rewarded=True)
    trained_parts(model, config.trained)  # refuses what the policy does not have, before the folder is claimed
    refuse_goals(policy, config.goals.probability)
    augmented = config.goals.open_augmented(scenarios)
    if config.entropy_bonus:
        refuse_constant_entropy(model, scenarios[0], config.trained)

    def train(config: FinetuneConfig, fabric: Fabric) -> Path:
        run = TrainingRun(
            policy, scenarios, out, config, fabric,
            inputs={"augmented_goals": augmented.fingerprint} if augmented else {}, num_rollouts=config.num_rollouts,
            skip_rule=f"KL above max_kl={config.max_kl} or not finite",
            remedy="lower learning_rate or raise kl.initial_beta",
            may_grow=("epochs",),  # the learning rate is constant: a longer run passes through the same weights
        )  # fmt: skip
        learner = prepare(model, config, fabric.device, augmented)
        unwarned = list(parse_reward(config.reward))

        def make_update() -> UpdateReport:
            batch = run.local_batch(learner.update).to(fabric.device)
            values = update_policy(learner, batch, config, fabric)
            levels, alarms = learner.alarms.watch(values, config.alarms)
            if learner.update == 1 and (values["reward_zero_rate"] == 1 or values["gradient_norm"] == 0):
                alarms.append(f"no reward reached a trained weight (RMM {values['rmm']:.3f})")
            for term in [term for term in unwarned if values[missing_rate_of(term)]]:
                unwarned.remove(term)
                count = round(values[missing_rate_of(term)] * config.batch_size)
                alarms.append(f"reward {term}: not finite in {count} of {config.batch_size} scenarios, counted as 0")
            cause = f"KL {values['kl']:.3g} nats per decision is above max_kl={config.max_kl:g}"
            if not math.isfinite(values["gradient_norm"]):
                cause = "its gradient is not finite"
            note = f"RMM {values['rmm']:.3f}, KL {values['kl']:.4f}, beta {learner.beta:.3f}"
            return UpdateReport({**values, **levels}, note, cause, alarms)

        return run.train(learner, make_update, title="fine-tune", card=card)

    return train_in_processes(train, config, len(scenarios), out)


def prepare(
    policy: nn.Module, config: FinetuneConfig, device: torch.device, augmented: StoredGoals | None = None
) -> RewardLearner:
    """Freeze the weights that are not trained, copy the reference, make the optimizer. Dropout is off from here on.

    Args:
        policy: changed in place.
        config: see its fields.
        device: to train on.
        augmented: goals beside the logged endpoints.
    """
    # With dropout the scored distribution would not be the one that was sampled from.
    policy.to(device).eval()
    freeze_untrained(policy, config.trained)
    optimizer = torch.optim.AdamW(
        parameter_groups(policy, config.goals.learning_rate_scale),
        lr=config.learning_rate,
        betas=config.betas,
        weight_decay=config.weight_decay,
    )
    reference = copy.deepcopy(policy).requires_grad_(False)
    beta = config.kl.initial_beta
    return RewardLearner(policy=policy, reference=reference, optimizer=optimizer, beta=beta, augmented_goals=augmented)


def update_policy(
    learner: RewardLearner, batch: ScenarioBatch, config: FinetuneConfig, fabric: Fabric
) -> dict[str, float]:
    """Make one update of the policy, as in RLFTSim, section 4.1.

    Args:
        learner: changed in place.
        batch: this process's scenarios of the update, with their futures.
        config: see its fields.
        fabric: processes and precision.

    Returns:
        Metrics by the names of metrics.jsonl.
    """
    clock = UpdateClock(fabric.device)
    experiences: list[Experience] = []
    own = local_rollouts(config.batch_size, config.num_rollouts, fabric)
    for part in batch.split(max(config.micro_batch_size // num_sharing_memory(fabric), 1)):
        # 1. Sample N rollouts of each scenario under this update's goals, without gradient.
        context, rollouts = sample_rollouts(
            learner.policy, part, config.goals, learner.augmented_goals,
            num_rollouts=config.num_rollouts, own=own, seed=config.seed, update=learner.update, fabric=fabric,
        )  # fmt: skip
        clock.lap("rollout")
        # 2. Measure their realism and the reward that each rollout, or each agent in it, earns.
        realism, rewards = compute_reward(part, rollouts, config)
        experiences.append(Experience(part, rollouts, realism, rewards, context, own))
        clock.lap("reward")
    speed = {}
    if config.hold_speed:  # over the whole batch, so not by part
        experiences, speed["speed_slope"] = hold_speed(experiences, fabric)
    # 3. Score them under policy and reference: gradient of the policy-gradient loss with its KL penalty, and of the
    # pre-training loss where it has a weight.
    terms = LossTerms(
        *count_decisions(experiences, fabric), learner.beta, config.entropy_bonus, config.log_prob_reduction,
        config.kl.condition_reference, config.imitation_weight, learner.update, config.seed,
    )  # fmt: skip
    learner.optimizer.zero_grad(set_to_none=True)
    sums = accumulate_gradients(
        learner.policy, learner.reference, experiences, terms, fabric, rollouts_per_pass=config.rollouts_per_pass
    )
    # 4. Score them again under goals that one of them has met: gradient of the goal reward in hindsight.
    hindsight = accumulate_hindsight(
        learner.policy, experiences, parse_reward(config.reward), sums, terms, fabric,
        weight=config.goals.hindsight, rollouts_per_pass=config.rollouts_per_pass,
    )  # fmt: skip
    all_reduce_gradients(learner.parameters, fabric)
    clock.lap("backward")
    # 5. Take the optimizer's step, or skip it where the gradient is not finite or the KL exploded.
    norm = float(torch.nn.utils.clip_grad_norm_(learner.parameters, config.gradient_clip))
    warmup = min((learner.update + 1) / max(config.warmup_updates, 1), 1.0)
    set_learning_rate(learner.optimizer, config.learning_rate * warmup)
    learner.finish_update(is_good=math.isfinite(norm) and sums.kl <= config.max_kl)
    values = {
        **describe(experiences, fabric), **speed, "kl": sums.kl, "entropy": sums.entropy, **hindsight,
        **sums.imitation, "score_gap": sums.score_gap, "beta": learner.beta, "gradient_norm": norm,
        "skipped": float(learner.skipped_in_a_row),
    }  # fmt: skip
    # 6. Adapt the strength of the KL penalty to the KL of this update.
    if not learner.skipped_in_a_row:
        learner.beta = adapt_beta(learner.beta, sums.kl, config.kl)
    # 7. Move the reference a little towards the policy, now and then.
    if config.kl.reference_sync_every and learner.update % config.kl.reference_sync_every == 0:
        sync_reference(learner.reference, learner.policy, config.kl.reference_ema)
    clock.lap("step")
    return {**values, "learning_rate": learner.optimizer.param_groups[0]["lr"], **clock.seconds}
