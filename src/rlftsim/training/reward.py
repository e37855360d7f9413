"""Closed-loop fine-tuning with rewards: sample, reward, score, update, sync the reference (RLFTSim, section 4).

The main path of this package; `update_policy` is a single update, in seven steps.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from rlftsim.rewards import parse_reward
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.config import FinetuneConfig, KlConfig
from rlftsim.training.constraints import Prices, check_constraints
from rlftsim.training.experience import (
    Experience,
    UpdateClock,
    compute_reward,
    count_decisions,
    describe,
    missing_rate_name,
    sample_rollouts,
)
from rlftsim.training.freezing import (
    check_entropy,
    freeze_untrained,
    parameter_groups,
    select_trained_modules,
    set_learning_rate,
)
from rlftsim.training.goals import StoredGoals, check_goals, open_augmented
from rlftsim.training.hindsight import accumulate_hindsight, check_hindsight
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.monitoring import Alarms
from rlftsim.training.parallel import Fabric, all_reduce_gradients, local_rollouts, num_sharing_memory
from rlftsim.training.policy_gradient import LossTerms, accumulate_gradients
from rlftsim.training.scored_rollouts import choose_scored


@dataclass(eq=False, kw_only=True)
class RewardLearner(Learner):
    """A policy in fine-tuning with the frozen reference, the KL penalty's strength, prices and alarms."""

    reference: Any
    beta: float
    augmented_goals: StoredGoals | None = None
    """Goals beside the logged endpoints."""
    prices: Prices
    """Multipliers of the constraints."""
    alarms: Alarms = field(default_factory=Alarms)
    warned_terms: set[str] = field(default_factory=set)
    """Terms of the reward that a message has called not finite."""

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds: also the reference."""
        return super().modules | {"reference": self.reference}

    def to_numbers(self) -> dict[str, float]:
        """Beta, prices and the alarms' running means."""
        return {"beta": self.beta, **self.prices.to_numbers(), **self.alarms.to_numbers()}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back beta, prices and the alarms' running means."""
        self.beta = numbers["beta"]
        self.prices.load_numbers(numbers)
        self.alarms.load_numbers(numbers)


class RewardMethod(Method[FinetuneConfig]):
    """Policy gradient on rewards ("rlft")."""

    settings = FinetuneConfig
    title = "fine-tune"
    validates = True

    def describe(self, settings: FinetuneConfig) -> str:
        """The reward."""
        return settings.reward

    def start(self, policy: Any, scenarios: Scenarios, settings: FinetuneConfig, fabric: Fabric) -> RewardLearner:
        """Check the policy, open augmented goals, and `prepare`."""
        check_trainable(policy, scenarios, "rewards", is_imitated=settings.imitation_weight > 0, is_rewarded=True)
        select_trained_modules(policy, settings.trained)
        check_goals(policy, settings.goals.probability)
        check_constraints(settings.constraints)
        check_hindsight(settings)
        augmented = open_augmented(settings.goals, scenarios)
        if settings.entropy_bonus:
            check_entropy(policy, scenarios[0], settings.trained)
        return prepare(policy, settings, fabric.device, augmented)

    def update(self, learner: RewardLearner, scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """One `update_policy`, with the resulting messages."""
        config = learner.config
        values = update_policy(learner, scenarios.batch(config.num_rollouts), config, fabric)
        levels, raised = learner.alarms.watch(values, config.alarms)
        alarms = [*raised]
        if learner.update == 1 and (values["reward_zero_rate"] == 1 or values["gradient_norm"] == 0):
            alarms.append(f"no reward reached a trained weight (RMM {values['rmm']:.3f})")
        for term in parse_reward(config.reward):
            rate = values[missing_rate_name(term)]
            if rate and term.name not in learner.warned_terms:
                learner.warned_terms.add(term.name)
                count = round(rate * config.batch_size)
                alarms.append(f"reward {term}: not finite in {count} of {config.batch_size} scenarios, counted as 0")
        cause = f"KL {values['kl']:.3g} nats per decision is above max_kl={config.max_kl:g}"
        if not math.isfinite(values["gradient_norm"]):
            cause = "its gradient is not finite"
        changes = "".join(f", {name} {values[f'change_{name}']:+.3f}" for name in config.constraints)
        note = f"RMM {values['rmm']:.3f}, KL {values['kl']:.4f}, beta {learner.beta:.3f}{changes}"
        stop_because = f"{raised[0]}" if config.alarms.stop and raised else ""
        return UpdateReport({**values, **levels}, note, cause, alarms, stop_because)


def prepare(
    policy: nn.Module, config: FinetuneConfig, device: torch.device, augmented: StoredGoals | None = None
) -> RewardLearner:
    """Freeze the weights that are not trained, copy the reference, make the optimizer. Dropout is off from here on.

    Args:
        policy: Policy to train in place.
        config: Settings of the run; a stored run resumes only with equal settings.
        device: Device to train on; the policy moves there.
        augmented: Stored goals beside the logged endpoints; None = endpoints alone.
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
    return RewardLearner(
        policy=policy, reference=reference, optimizer=optimizer, config=config, beta=beta, augmented_goals=augmented,
        prices=Prices(config.constraints),
        inputs={"augmented_goals": augmented.fingerprint} if augmented else {},
        may_grow=("epochs",),  # the learning rate is constant: a longer run passes through the same weights
        skip_rule=f"KL above max_kl={config.max_kl} or not finite",
        remedy="lower learning_rate or raise kl.initial_beta",
    )  # fmt: skip


def update_policy(
    learner: RewardLearner, batch: ScenarioBatch, config: FinetuneConfig, fabric: Fabric
) -> dict[str, float]:
    """Make an update of the policy, as in RLFTSim, section 4.1.

    Args:
        learner: Policy, reference and counters, changed in place.
        batch: this process's scenarios of the update, with futures.
        config: Settings of the run; a stored run resumes only with equal settings.
        fabric: Processes of the run, and the precision of passes.

    Returns:
        Metrics by the names of metrics.jsonl.
    """
    clock = UpdateClock(fabric.device)
    experiences: list[Experience] = []
    rollout_ids = local_rollouts(config.batch_size, config.num_rollouts, fabric)
    for micro_batch in batch.split(max(config.micro_batch_size // num_sharing_memory(fabric), 1)):
        # 1. Sample N rollouts of each scenario under this update's goals, without gradient.
        context, rollouts = sample_rollouts(learner, micro_batch, config, rollout_ids, fabric)
        clock.lap("rollout")
        # 2. Measure their realism and the reward that each rollout, or each agent in it, earns.
        rewarded = compute_reward(micro_batch, rollouts, config)
        experiences.append(Experience(micro_batch, rollouts, *rewarded, context, rollout_ids))
        clock.lap("reward")
    # 3. Take the price of constrained means from the rewards, and score those rollouts that carry most, under policy
    # and reference: gradient of the policy-gradient loss with its KL penalty, and of the pre-training loss where it has
    # a weight. Over the whole batch, so not by part.
    scored, constrained = choose_scored(learner, experiences, config, fabric)
    clock.lap("constraints")
    terms = LossTerms(*count_decisions(experiences, fabric), learner.beta, learner.update, config)
    learner.optimizer.zero_grad(set_to_none=True)
    sums = accumulate_gradients(learner.policy, learner.reference, scored, terms, fabric)
    # 4. Score them again under goals that one of them has met: gradient of the goal reward in hindsight.
    hindsight = accumulate_hindsight(learner.policy, experiences, sums, terms, fabric)
    all_reduce_gradients(learner.parameters, fabric)
    clock.lap("backward")
    # 5. Take the optimizer's step, or skip it where the gradient is not finite or the KL exploded.
    norm = float(torch.nn.utils.clip_grad_norm_(learner.parameters, config.gradient_clip))
    warmup = min((learner.update + 1) / max(config.warmup_updates, 1), 1.0)
    set_learning_rate(learner.optimizer, config.learning_rate * warmup)
    learner.finish_update(is_good=math.isfinite(norm) and sums.kl <= config.max_kl)
    values = {
        **describe(experiences, fabric), **constrained, "kl": sums.kl, "entropy": sums.entropy,
        **hindsight, **sums.imitation, "score_gap": sums.score_gap, "beta": learner.beta, "gradient_norm": norm,
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


def adapt_beta(beta: float, kl: float, config: KlConfig) -> float:
    """Strength of the penalty after an update, within bounds: beta (1 + clip(KL/target - 1, -0.2, 0.2) / horizon).

    Args:
        beta: strength during the update.
        kl: KL of the update, nats per decision.
        config: target, horizon and bounds.
    """
    # Clipped, so that one wild update moves beta by at most 0.2 / horizon.
    error = min(max(kl / config.target - 1.0, -0.2), 0.2)
    return min(max(beta * (1.0 + error / config.horizon), config.min_beta), config.max_beta)


@torch.no_grad()
def sync_reference(reference: nn.Module, policy: nn.Module, alpha: float) -> None:
    """Move the reference's weights towards the policy's, in place: alpha * policy + (1 - alpha) * reference.

    Args:
        reference: Reference, moved in place towards the policy.
        policy: has the same parameters in the same order.
        alpha: Weight of the policy, in [0, 1].
    """
    for old, new in zip(reference.parameters(), policy.parameters()):
        old.lerp_(new, alpha)
