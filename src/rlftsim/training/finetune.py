"""Closed-loop fine-tuning: sample, reward, score, update, reference. RLFTSim, section 4.

`finetune` is the main path of this package; an update reads top to bottom in `update_policy`.
"""

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_finite, require_not_negative, require_positive
from rlftsim.goals.stored import StoredGoals
from rlftsim.progress import progress_bar, say
from rlftsim.realism import AgentScores, RealismResult, measure_batch, metric_by_name, score_measured
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.alarms import AlarmConfig, Alarms
from rlftsim.training.checkpoint import Progress, newest_checkpoint, read_checkpoint, write_checkpoint
from rlftsim.training.data import batch_with_futures, scenarios_of_update
from rlftsim.training.experience import Experience, describe
from rlftsim.training.freezing import TrainedParts, freeze_untrained, parameter_groups, set_learning_rate
from rlftsim.training.goals import GoalConfig, choose_goals, refuse_goals
from rlftsim.training.hindsight import clipped_ratio, goal_terms, look_back
from rlftsim.training.parallel import DeviceConfig, add_up, add_up_gradients, own_share, start_fabric
from rlftsim.training.policy_gradient import Reduction, agent_log_prob, masked_sum, policy_gradient_loss
from rlftsim.training.reference import KlConfig, adapt_beta, move_reference
from rlftsim.training.rewards import CreditTo, Rewards, compute_rewards, parse_reward, write_reward
from rlftsim.training.run_folder import RunFolder, describe_inputs


@dataclass(frozen=True)
class FinetuneConfig:
    """How a policy is fine-tuned. The defaults are the paper's hyper-parameters."""

    epochs: float = 1.0
    """Passes over the training scenarios."""
    batch_size: int = 8
    """Scenarios per update, over all processes (B)."""
    num_rollouts: int = 4
    """Rollouts per scenario and update (N)."""
    micro_batch_size: int = 8
    """Scenarios in memory at once, in each process; fewer need less memory, the update is the same."""
    rollouts_per_pass: int = 4
    """Rollouts of each that are scored with gradient at once; fewer need less memory, the update is the same."""
    reward: str = "mloo"
    """A registered reward, or a sum such as "mloo + 0.1*collision_offroad"; kept with its options' defaults filled in."""
    metric: str = "2025"
    """Configuration of the meta-metric the reward is made of."""
    credit: CreditTo = "rollout"
    """Whom a reward is owed to: every decision of the rollout alike, or to each agent its own share, see `rewards.composition`."""
    shared_credit: float = 0.1
    """With credit by agent: the share of what the others earned."""
    learning_rate: float = 3e-6
    warmup_updates: int = 100
    """The learning rate rises linearly over them and is constant from then on."""
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    entropy_bonus: float = 0.0
    log_prob_reduction: Reduction = "mean"
    """Over agents and decisions. The mean keeps the size of an update independent of how many agents a scene has."""
    trained: TrainedParts = "decoder"
    """The parts a policy names for fine-tuning, or everything."""
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
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        if self.num_rollouts < 2:
            raise ConfigError(
                f"MLOO needs at least 2 rollouts per scenario, got {self.num_rollouts}: set finetune.num_rollouts >= 2."
            )
        positive = (
            "epochs",
            "batch_size",
            "micro_batch_size",
            "rollouts_per_pass",
            "learning_rate",
            "gradient_clip",
            "checkpoint_every",
            "max_kl",
            "max_skipped_in_a_row",
        )
        require_positive(self, positive)
        require_not_negative(self, ("warmup_updates", "weight_decay"))
        require_finite(self, ("epochs", "learning_rate", "weight_decay", "entropy_bonus"))
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas are shares in [0, 1), got {self.betas}.")
        if not 0 <= self.shared_credit <= 1:
            raise ConfigError(f"shared_credit is a share in [0, 1], got {self.shared_credit}.")
        metric_by_name(self.metric)
        object.__setattr__(self, "reward", write_reward(parse_reward(self.reward)))
        asks = bool(goal_terms(parse_reward(self.reward)))
        if asks and not self.goals.share:
            raise ConfigError(f"reward {self.reward!r} needs goals: set finetune.goals.share above 0, such as 1.")
        if self.goals.hindsight and not asks:
            raise ConfigError(
                f"goals.hindsight has no effect with reward {self.reward!r}: add a term, such as 0.1*goal."
            )

    def num_updates(self, num_scenarios: int) -> int:
        """Optimiser steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(eq=False)
class Learner:
    """The parts of a run that change from update to update."""

    policy: Any
    reference: Any
    optimizer: torch.optim.Optimizer
    beta: float
    augmented_goals: StoredGoals | None = None
    """Goals beside the recorded ones."""
    update: int = 0
    skipped_in_a_row: int = 0
    alarms: Alarms = field(default_factory=Alarms)

    @property
    def parameters(self) -> list[nn.Parameter]:
        """What is trained."""
        return [p for p in self.policy.parameters() if p.requires_grad]


def finetune(policy: Policy, scenarios: Scenarios, out: Path, config: FinetuneConfig, *, card: str = "") -> Path:
    """Fine-tune a policy in place; go on where a run in `out` was stopped.

    Args:
        policy: an nn.Module that implements `rollout.policy.Policy`.
        scenarios: with their futures.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged (its last good checkpoint is named).
    """
    if not isinstance(policy, nn.Module):
        raise ConfigError(f"{type(policy).__name__} has no weights: there is nothing to fine-tune.")
    if not hasattr(policy, "save_pretrained"):
        raise ConfigError(
            f"{type(policy).__name__} cannot be saved: give it a method save_pretrained(folder, *, card)."
        )
    if not len(scenarios):
        raise ConfigError("no scenario to train on: is the data set empty, or the split misspelt?")
    refuse_goals(policy, config.goals.share)
    augmented = config.goals.open_augmented(scenarios)
    fabric = start_fabric(config.device)
    inputs = describe_inputs(policy, scenarios) | ({"augmented_goals": augmented.fingerprint} if augmented else {})
    run = RunFolder(out, config, inputs, writes=fabric.is_global_zero)
    learner = prepare(policy, config, fabric.device, augmented)
    _resume(learner, run)
    total = config.num_updates(len(scenarios))
    with progress_bar("fine-tune", total, learner.update) as advance:
        while learner.update < total:
            chosen = own_share(
                scenarios_of_update(learner.update, config.batch_size, len(scenarios), config.seed), fabric
            )
            batch = batch_with_futures(scenarios, chosen).to(fabric.device)
            values = update_policy(learner, batch, config, fabric)
            levels, alarms = learner.alarms.watch(values, config.alarms)
            run.log(learner.update, {**values, **levels})
            if fabric.is_global_zero:
                _tell(learner, values, alarms, config)
            _stop_if_diverged(learner, run, config)
            if fabric.is_global_zero and _is_checkpoint_due(learner, config, total):
                write_checkpoint(run.checkpoints, _progress(learner), _modules(learner), learner.optimizer)
            advance(note=f"RMM {values['rmm']:.3f}, KL {values['kl']:.4f}, beta {learner.beta:.3f}")
    run.close()
    if fabric.is_global_zero:
        policy.save_pretrained(run.model, card=card)  # type: ignore[operator]
    return run.model


def prepare(
    policy: nn.Module, config: FinetuneConfig, device: torch.device, augmented: StoredGoals | None = None
) -> Learner:
    """Freeze what is not trained, copy the reference, make the optimiser. Dropout is off from here on."""
    policy.to(device).eval()
    freeze_untrained(policy, config.trained)
    reference = copy.deepcopy(policy).requires_grad_(False)
    optimizer = torch.optim.AdamW(
        parameter_groups(policy, config.goals.learning_rate_scale),
        lr=config.learning_rate,
        betas=config.betas,
        weight_decay=config.weight_decay,
    )
    return Learner(policy, reference, optimizer, config.kl.initial_beta, augmented)


def update_policy(learner: Learner, batch: ScenarioBatch, config: FinetuneConfig, fabric: Fabric) -> dict[str, float]:
    """One update: everything of RLFTSim's section 4.1, in order. Returns what is logged."""
    clock = _Clock(fabric.device)
    seeds = {what: derive_seed(config.seed, what, learner.update) for what in ("rollouts", "goals")}
    experiences = []
    for part in batch.split(config.micro_batch_size):
        goals = choose_goals(part, config.goals, learner.augmented_goals, seed=seeds["goals"])
        # 1 sample N rollouts of each scenario, without gradient
        with fabric.autocast():
            rollouts = simulate(
                learner.policy, part, num_rollouts=config.num_rollouts, seed=seeds["rollouts"], goals=goals
            )
        clock.lap("rollout")
        # 2 reward
        scores, rewards = compute_reward(part, rollouts, config)
        experiences.append(Experience(part, rollouts, scores, rewards))
        clock.lap("reward")
    # 3 log-probabilities under policy and reference, 4 loss and gradients, slice by slice
    num_scenarios, num_decisions = _count(experiences, fabric)
    sums, asked = _accumulate_gradients(learner, experiences, config, fabric, num_scenarios, num_decisions)
    ratios = _accumulate_hindsight(learner, experiences, asked, config, fabric, num_scenarios)
    add_up_gradients(learner.parameters, fabric)
    clock.lap("backward")
    # 5 step, 6 penalty, 7 reference
    count = max(sums.count, 1.0)
    kl, norm = sums.kl / count, _step(learner, sums, config)
    values = {**describe(experiences, fabric), "kl": kl, "entropy": sums.entropy / count, **ratios}
    values |= {
        "score_gap": sums.gap,
        "beta": learner.beta,
        "gradient_norm": norm,
        "skipped": float(learner.skipped_in_a_row),
    }
    if not learner.skipped_in_a_row:
        learner.beta = adapt_beta(learner.beta, kl, config.kl)
    if config.kl.reference_every and learner.update % config.kl.reference_every == 0:
        move_reference(learner.reference, learner.policy, config.kl.reference_share)
    clock.lap("step")
    return {**values, "learning_rate": learner.optimizer.param_groups[0]["lr"], **clock.seconds}


def compute_reward(batch: ScenarioBatch, rollouts: Rollouts, config: FinetuneConfig) -> tuple[RealismResult, Rewards]:
    """The rollouts' scores and what they earn. Everything is made of features that are measured once.

    A scenario without map counts as on the road; one that has no finite score earns 0.
    """
    metric = metric_by_name(config.metric)
    measured = measure_batch(batch.scenarios, states_of_rollouts(batch, rollouts), missing_map="neutral")
    scores = score_measured(measured, metric)
    agents = AgentScores(measured, metric, batch.agent_mask.shape[1]) if config.credit == "agent" else None
    return scores, compute_rewards(
        parse_reward(config.reward), scores, rollouts, batch, agents, shared=config.shared_credit
    )


@dataclass
class _Sums:
    """What an update added up, over slices and processes."""

    kl: float
    entropy: float
    gap: float
    """Largest difference between a log-probability as sampled and as scored, in this process."""
    count: float


AskedLogProb = list[list[Float[Tensor, "_ _ _"]]]
"""By experience and slice: log-probability of all of an agent's decisions, under the goals that were asked."""


def _accumulate_gradients(
    learner: Learner,
    experiences: Sequence[Experience],
    config: FinetuneConfig,
    fabric: Fabric,
    num_scenarios: int,
    num_decisions: float,
) -> tuple[_Sums, AskedLogProb]:
    """Score the rollouts under policy and reference and leave this process's gradient of the loss in the policy's parameters.

    The reference is asked what the policy is asked, see `KlConfig.reference_asked`: one that was given eyes for this run sees nothing yet, one
    that followed goals before holds the policy to how it followed them.
    """
    learner.optimizer.zero_grad(set_to_none=True)
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    gaps: list[Tensor] = []
    asked: AskedLogProb = []
    for experience in experiences:
        asked.append([])
        with fabric.autocast(), torch.no_grad():
            reference_context = learner.reference.encode(experience.batch)
        for rows, reward in experience.slices(config.rollouts_per_pass):
            mask = rows.decision_mask
            held_rows = rows if config.kl.reference_asked else replace(rows, goals=None)
            with fabric.autocast():
                scored = learner.policy.score(learner.policy.encode(experience.batch), rows)
                with torch.no_grad():
                    held = learner.reference.score(reference_context, held_rows)
            log_prob = scored.log_prob(rows.decision)
            kl, entropy = masked_sum(scored.kl(held), mask), masked_sum(scored.entropy(), mask)
            by_agent = agent_log_prob(log_prob, mask, config.log_prob_reduction)
            loss = policy_gradient_loss(reward, by_agent, num_scenarios)
            loss = loss + (learner.beta * kl - config.entropy_bonus * entropy) / max(num_decisions, 1.0)
            fabric.backward(loss)
            sums += torch.stack([kl.detach(), entropy.detach()])
            gaps.append(torch.where(mask, log_prob.detach() - rows.log_prob, 0.0).abs().max())
            asked[-1].append(agent_log_prob(log_prob.detach(), mask, "sum"))
    kl, entropy = add_up(sums, fabric).tolist()
    return _Sums(kl, entropy, float(torch.stack(gaps).max()), num_decisions), asked


def _accumulate_hindsight(
    learner: Learner,
    experiences: Sequence[Experience],
    asked: AskedLogProb,
    config: FinetuneConfig,
    fabric: Fabric,
    num_scenarios: int,
) -> dict[str, float]:
    """Add the gradient of what is earned under other goals. Returns what is logged; nothing in a run without hindsight.

    What is earned is weighted by the ratio of probabilities, divided by its mean over the agents of the whole batch. The mean is known
    in the end, so this gradient is gathered apart.
    """
    if not config.goals.hindsight:
        return {}
    gathered = [parameter.grad for parameter in learner.parameters]
    learner.optimizer.zero_grad(set_to_none=True)
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    others = look_back(experiences, parse_reward(config.reward))
    for other, log_probs in zip(others, asked):
        for (rows, reward), old in zip(other.slices(config.rollouts_per_pass), log_probs):
            mask, decides = rows.decision_mask, rows.decision_mask.any(-1)
            with fabric.autocast():
                scored = learner.policy.score(learner.policy.encode(other.batch), rows)
            log_prob = scored.log_prob(rows.decision)
            ratio = clipped_ratio(agent_log_prob(log_prob, mask, "sum"), old)
            by_agent = agent_log_prob(log_prob, mask, config.log_prob_reduction)
            fabric.backward(policy_gradient_loss(reward * ratio, by_agent, num_scenarios))
            sums += torch.stack([ratio[decides].sum(), decides.sum()])
    total, count = add_up(sums, fabric).tolist()
    mean = total / max(count, 1.0)
    for parameter, before in zip(learner.parameters, gathered):
        if parameter.grad is not None:
            parameter.grad *= config.goals.hindsight / max(mean, 1e-6)
        if before is not None:
            parameter.grad = before if parameter.grad is None else parameter.grad.add_(before)
    return {"hindsight_ratio": mean}


def _count(experiences: Sequence[Experience], fabric: Fabric) -> tuple[int, float]:
    """Scenarios and decisions in the whole batch, other processes' included."""
    counts = [(e.batch.num_scenarios, int(e.rollouts.decision_mask.sum())) for e in experiences]
    totals = torch.tensor(counts, device=fabric.device, dtype=torch.float64).sum(0)
    num_scenarios, num_decisions = add_up(totals, fabric).tolist()
    return int(num_scenarios), num_decisions


def _step(learner: Learner, sums: _Sums, config: FinetuneConfig) -> float:
    """Take the optimiser's step, or skip it where something is not finite or the KL exploded. Returns the gradient norm."""
    norm = float(torch.nn.utils.clip_grad_norm_(learner.parameters, config.gradient_clip))
    rate = config.learning_rate * min((learner.update + 1) / max(config.warmup_updates, 1), 1.0)
    set_learning_rate(learner.optimizer, rate)
    learner.update += 1
    if math.isfinite(norm) and sums.kl / max(sums.count, 1.0) <= config.max_kl:
        learner.optimizer.step()
        learner.skipped_in_a_row = 0
    else:
        learner.skipped_in_a_row += 1
    return norm


def _tell(learner: Learner, values: dict[str, float], alarms: list[str], config: FinetuneConfig) -> None:
    """Say what a person should know at once: an update that was skipped, and why; alarms that begin to ring."""
    if learner.skipped_in_a_row:
        cause = f"KL {values['kl']:.3g} nats per decision is above max_kl={config.max_kl:g}"
        if not math.isfinite(values["gradient_norm"]):
            cause = "its gradient is not finite"
        limit = f"{learner.skipped_in_a_row} in a row, the run stops at {config.max_skipped_in_a_row}"
        say(f"update {learner.update} skipped: {cause} ({limit})")
    for alarm in alarms:
        say(f"update {learner.update}, {alarm}")


def _stop_if_diverged(learner: Learner, run: RunFolder, config: FinetuneConfig) -> None:
    if learner.skipped_in_a_row >= config.max_skipped_in_a_row:
        cause = (
            f"{learner.skipped_in_a_row} updates in a row were skipped, KL above max_kl={config.max_kl} or not finite"
        )
        raise run.diverged(cause, "lower learning_rate or raise kl.initial_beta")


def _is_checkpoint_due(learner: Learner, config: FinetuneConfig, total: int) -> bool:
    good = not learner.skipped_in_a_row
    return good and (learner.update % config.checkpoint_every == 0 or learner.update == total)


def _modules(learner: Learner) -> dict[str, nn.Module]:
    return {"policy": learner.policy, "reference": learner.reference}


def _progress(learner: Learner) -> Progress:
    return Progress(learner.update, {"beta": learner.beta, **learner.alarms.to_numbers()})


def _resume(learner: Learner, run: RunFolder) -> None:
    """Go on from the newest checkpoint, if there is one."""
    newest = newest_checkpoint(run.checkpoints)
    if newest:
        progress = read_checkpoint(newest, _modules(learner), learner.optimizer)
        learner.update, learner.beta = progress.update, progress.numbers["beta"]
        learner.alarms.load_numbers(progress.numbers)
    run.continue_from(learner.update)


class _Clock:
    """Seconds spent in each kind of lap, the device's work included."""

    def __init__(self, device: torch.device) -> None:
        self.seconds: dict[str, float] = {}
        self._device = device
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        now = time.perf_counter()
        name = f"seconds_{name}"
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now
