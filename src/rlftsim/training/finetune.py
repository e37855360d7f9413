"""Closed-loop fine-tuning: sample, reward, score, update, reference. RLFTSim, section 4.

`finetune` is the main path of this package; an update reads top to bottom in `_update`.
"""

import copy
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_positive
from rlftsim.progress import progress_bar
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.checkpoint import Progress, newest_checkpoint, read_checkpoint, write_checkpoint
from rlftsim.training.data import batch_with_futures, scenarios_of_update
from rlftsim.training.parallel import DeviceConfig, add_up, add_up_gradients, own_share, start_fabric
from rlftsim.training.policy_gradient import Reduction, masked_sum, policy_gradient_loss, rollout_log_prob
from rlftsim.training.reference import KlConfig, adapt_beta, move_reference
from rlftsim.training.rewards import Reward, reward_by_name
from rlftsim.training.rewards.base import finite_or_zero
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
    rollouts_per_pass: int = 4
    """Rollouts that are scored with gradient at once; fewer need less memory, the update is the same."""
    reward: str = "mloo"
    metric: str = "2025"
    """Configuration of the meta-metric the reward is made of."""
    learning_rate: float = 3e-6
    warmup_updates: int = 100
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    entropy_bonus: float = 0.0
    log_prob_reduction: Reduction = "mean"
    """Over agents and decisions. The mean keeps the size of an update independent of how many agents a scene has."""
    trained: Literal["decoder", "all"] = "decoder"
    """The parts a policy names for fine-tuning, or everything."""
    kl: KlConfig = field(default_factory=KlConfig)
    max_kl: float = 5.0
    """Nats per decision; an update that exceeds it, or is not finite, is skipped."""
    max_skipped_in_a_row: int = 5
    """After so many skipped updates the run stops with its last good checkpoint."""
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
            "rollouts_per_pass",
            "learning_rate",
            "checkpoint_every",
            "max_kl",
            "max_skipped_in_a_row",
        )
        require_positive(self, positive)
        metric_by_name(self.metric)
        reward_by_name(self.reward)

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
    update: int = 0
    skipped_in_a_row: int = 0

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
    fabric = start_fabric(config.device)
    run = RunFolder(out, config, describe_inputs(policy, scenarios), writes=fabric.is_global_zero)
    learner = prepare(policy, config, fabric.device)
    _resume(learner, run)
    total = config.num_updates(len(scenarios))
    with progress_bar("fine-tune", total, learner.update) as advance:
        while learner.update < total:
            chosen = own_share(
                scenarios_of_update(learner.update, config.batch_size, len(scenarios), config.seed), fabric
            )
            batch = batch_with_futures(scenarios, chosen).to(fabric.device)
            values = update_policy(learner, batch, config, fabric)
            run.log(learner.update, values)
            _stop_if_diverged(learner, run, config)
            if fabric.is_global_zero and _is_checkpoint_due(learner, config, total):
                write_checkpoint(run.checkpoints, _progress(learner), _modules(learner), learner.optimizer)
            advance(note=f"RMM {values['rmm']:.3f}, KL {values['kl']:.4f}, beta {learner.beta:.3f}")
    run.close()
    if fabric.is_global_zero:
        policy.save_pretrained(run.model, card=card)  # type: ignore[operator]
    return run.model


def prepare(policy: nn.Module, config: FinetuneConfig, device: torch.device) -> Learner:
    """Freeze what is not trained, copy the reference, make the optimiser. Dropout is off from here on."""
    policy.to(device).eval()
    parts = getattr(policy, "fine_tuned_parts", None)
    policy.requires_grad_(config.trained == "all" or parts is None)
    for part in parts() if parts and config.trained == "decoder" else ():
        part.requires_grad_(True)
    reference = copy.deepcopy(policy).requires_grad_(False)
    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(
        trained, lr=config.learning_rate, betas=config.betas, weight_decay=config.weight_decay
    )
    return Learner(policy, reference, optimizer, config.kl.initial_beta)


def update_policy(learner: Learner, batch: ScenarioBatch, config: FinetuneConfig, fabric: Fabric) -> dict[str, float]:
    """One update: everything of RLFTSim's section 4.1, in order. Returns what is logged."""
    clock = _Clock()
    # 1 sample N rollouts of each scenario, without gradient
    seed = derive_seed(config.seed, "rollouts", learner.update)
    with fabric.autocast():
        rollouts = simulate(learner.policy, batch, num_rollouts=config.num_rollouts, seed=seed)
    clock.lap("rollout")
    # 2 reward
    scores, reward = compute_reward(batch, rollouts, config)
    clock.lap("reward")
    # 3 log-probabilities under policy and reference, 4 loss and gradients, slice by slice
    sums = _accumulate_gradients(learner, batch, rollouts, reward, config, fabric)
    clock.lap("backward")
    # 5 step, 6 penalty, 7 reference
    count = max(sums.count, 1.0)
    kl, norm = sums.kl / count, _step(learner, sums, config)
    values = {**_describe(scores, reward, rollouts, fabric), "kl": kl, "entropy": sums.entropy / count}
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


def compute_reward(
    batch: ScenarioBatch, rollouts: Rollouts, config: FinetuneConfig
) -> tuple[RealismResult, Float[Tensor, "B N"]]:
    """The rollouts' scores and their rewards. A scenario without map counts as on the road; one that has no finite score earns 0."""
    reward: Reward = reward_by_name(config.reward)
    states = states_of_rollouts(batch, rollouts)
    scores = score_batch(batch.scenarios, states, metric_by_name(config.metric), missing_map="neutral")
    values = reward(scores, rollouts, batch)
    return scores, finite_or_zero(values)


@dataclass
class _Sums:
    """What an update added up, over slices and processes."""

    kl: float
    entropy: float
    gap: float
    """Largest difference between a log-probability as sampled and as scored, in this process."""
    count: float


def _accumulate_gradients(
    learner: Learner,
    batch: ScenarioBatch,
    rollouts: Rollouts,
    reward: Float[Tensor, "B N"],
    config: FinetuneConfig,
    fabric: Fabric,
) -> _Sums:
    """Score the rollouts under policy and reference and leave the loss's gradient in the policy's parameters."""
    learner.optimizer.zero_grad(set_to_none=True)
    totals = torch.tensor(
        [batch.num_scenarios, int(rollouts.decision_mask.sum())], device=fabric.device, dtype=torch.float64
    )
    num_scenarios, num_decisions = add_up(totals, fabric).tolist()
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    gaps: list[Tensor] = []
    with fabric.autocast(), torch.no_grad():
        reference_context = learner.reference.encode(batch)
    for start in range(0, config.num_rollouts, config.rollouts_per_pass):
        part = slice(start, start + config.rollouts_per_pass)
        rows, mask = rollouts.select(part), rollouts.decision_mask[:, part]
        with fabric.autocast():
            scored = learner.policy.score(learner.policy.encode(batch), rows)
            with torch.no_grad():
                held = learner.reference.score(reference_context, rows)
        log_prob = scored.log_prob(rows.decision)
        kl, entropy = masked_sum(scored.kl(held), mask), masked_sum(scored.entropy(), mask)
        by_rollout = rollout_log_prob(log_prob, mask, config.log_prob_reduction)
        loss = policy_gradient_loss(reward[:, part], by_rollout, int(num_scenarios))
        loss = loss + (learner.beta * kl - config.entropy_bonus * entropy) / max(num_decisions, 1.0)
        fabric.backward(loss)
        sums += torch.stack([kl.detach(), entropy.detach()])
        gaps.append(torch.where(mask, log_prob.detach() - rows.log_prob, 0.0).abs().max())
    add_up_gradients(learner.parameters, fabric)
    kl, entropy = add_up(sums, fabric).tolist()
    return _Sums(kl, entropy, float(torch.stack(gaps).max()), num_decisions)


def _step(learner: Learner, sums: _Sums, config: FinetuneConfig) -> float:
    """Take the optimiser's step, or skip it where something is not finite or the KL exploded. Returns the gradient norm."""
    norm = float(torch.nn.utils.clip_grad_norm_(learner.parameters, config.gradient_clip))
    rate = config.learning_rate * min((learner.update + 1) / max(config.warmup_updates, 1), 1.0)
    for group in learner.optimizer.param_groups:
        group["lr"] = rate
    learner.update += 1
    if math.isfinite(norm) and sums.kl / max(sums.count, 1.0) <= config.max_kl:
        learner.optimizer.step()
        learner.skipped_in_a_row = 0
    else:
        learner.skipped_in_a_row += 1
    return norm


def _stop_if_diverged(learner: Learner, run: RunFolder, config: FinetuneConfig) -> None:
    if learner.skipped_in_a_row >= config.max_skipped_in_a_row:
        cause = (
            f"{learner.skipped_in_a_row} updates in a row were skipped, KL above max_kl={config.max_kl} or not finite"
        )
        raise run.diverged(cause, "lower learning_rate or raise kl.initial_beta")


def _describe(
    scores: RealismResult, reward: Float[Tensor, "B N"], rollouts: Rollouts, fabric: Fabric
) -> dict[str, float]:
    """Means over scenarios (and processes) of what a person wants to watch."""
    ends = rollouts.position[..., -1, :]
    spread = (ends - ends.mean(1, keepdim=True)).norm(dim=-1)
    present = rollouts.decision_mask.any(-1)
    watched = {
        "reward_mean": reward.mean(),
        "reward_std": reward.std(-1).mean(),
        "reward_zero_rate": (reward == 0).all(-1).double().mean(),
        "rmm": scores.meta_metric.nanmean(),
        "kinematic": scores.kinematic.nanmean(),
        "interactive": scores.interactive.nanmean(),
        "map_based": scores.map_based.nanmean(),
        "ade_m": scores.average_displacement_error.nanmean(),
        "min_ade_m": scores.min_average_displacement_error.nanmean(),
        "collision_rate": scores.collision_rate.mean(),
        "offroad_rate": scores.offroad_rate.mean(),
        "traffic_light_violation_rate": scores.traffic_light_violation_rate.mean(),
        "diversity_m": spread[present].mean(),
    }
    values = add_up(torch.stack(list(watched.values())).double(), fabric) / fabric.world_size
    return dict(zip(watched, values.tolist()))


def _is_checkpoint_due(learner: Learner, config: FinetuneConfig, total: int) -> bool:
    good = not learner.skipped_in_a_row
    return good and (learner.update % config.checkpoint_every == 0 or learner.update == total)


def _modules(learner: Learner) -> dict[str, nn.Module]:
    return {"policy": learner.policy, "reference": learner.reference}


def _progress(learner: Learner) -> Progress:
    return Progress(learner.update, {"beta": learner.beta})


def _resume(learner: Learner, run: RunFolder) -> None:
    """Go on from the newest checkpoint, if there is one."""
    newest = newest_checkpoint(run.checkpoints)
    if newest:
        progress = read_checkpoint(newest, _modules(learner), learner.optimizer)
        learner.update, learner.beta = progress.update, progress.numbers["beta"]
    run.continue_from(learner.update)


class _Clock:
    """Seconds between laps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[f"seconds_{name}"] = now - self._last
        self._last = now
