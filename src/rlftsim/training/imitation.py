"""Learning by imitation: the loop that pre-training and CAT-K share. They differ in where a model's predictions come from.

Pre-training asks for predictions along the recorded tracks, CAT-K along rollouts of the model's own. The loss is the cross-entropy of
the token that leads to the record; its sum over everything that an update sees is divided by the number of predictions.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError, given, require_finite, require_not_negative, require_positive
from rlftsim.progress import progress_bar, say
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.smoothing import summed_log_prob_nearby
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.batches import micro_batches, scenario_costs
from rlftsim.training.checkpoint import Progress, newest_checkpoint, read_checkpoint, write_checkpoint
from rlftsim.training.data import batch_with_futures, scenarios_of_update, trained_agents
from rlftsim.training.freezing import parameter_groups, set_learning_rate
from rlftsim.training.parallel import DeviceConfig, add_up, add_up_gradients, own_share, start_fabric
from rlftsim.training.run_folder import RunFolder, describe_inputs
from rlftsim.training.validation import ValidationConfig, refuse_to_validate, validate

IMPOSSIBLE = -1e8
"""A token that cannot be chosen has a smaller logit than this."""


@runtime_checkable
class Prediction(Protocol):
    """What a model says of next tokens, and what it should have said."""

    @property
    def logits(self) -> Float[Tensor, "R V"]:
        """Of R predictions, over the vocabulary."""
        ...

    @property
    def target(self) -> Int64[Tensor, "R"]:
        """Token that should come next."""
        ...

    @property
    def target_mask(self) -> Bool[Tensor, "R"]:
        """True = the prediction counts."""
        ...

    @property
    def class_id(self) -> Int64[Tensor, "R"]:
        """Class whose tokens these are."""
        ...


Predict = Callable[[ScenarioBatch, Bool[Tensor, "B A"], int], Prediction]
"""Predictions, differentiable, for a batch, the agents that count and the number of the update (counted from 0)."""


@dataclass(frozen=True)
class ImitationConfig:
    """How a model learns from the record. The defaults are those of the published SMART-tiny on WOMD."""

    epochs: float = 32.0
    """Passes over the training scenarios."""
    batch_size: int = 80
    """Scenarios per update, over all processes."""
    micro_batch_size: int = 8
    """Scenarios in memory at once, at most; gradients add up over the rest."""
    micro_batch_cost: float | None = None
    """Thousands of map points in memory at once, an agent counted as 200, at most: large scenarios come in smaller groups. None = any."""
    learning_rate: float = 5e-4
    final_learning_rate_share: float = 0.01
    """The learning rate falls to this share along a cosine."""
    warmup_updates: int = 0
    goal_learning_rate_scale: float = 1.0
    """Of the weights that see goals, if there are any, against that of all others."""
    weight_decay: float = 0.01
    gradient_clip: float = 0.5
    label_smoothing: float = 0.1
    """The loss of a perfect model is then not zero."""
    label_smoothing_kind: Literal["uniform", "spatial"] = "uniform"
    """Where the smoothed share goes: to all tokens alike, or to those that lead near the right one, see `tokens.smoothing`."""
    context_radius_m: float | None = 150.0
    """A step of an agent farther from the ego than this is taken as not recorded. None = everything is seen."""
    trained_radius_m: float = 100.0
    """Agents farther from the ego at the current step are context only."""
    max_trained_agents: int | None = 32
    """Of a scenario; the evaluated ones always, the rest at random. None = all."""
    max_skipped_in_a_row: int = 5
    """An update whose gradient is not finite is skipped; after so many in a row the run stops."""
    checkpoint_every: int = 200
    """Updates."""
    seed: int = 0
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        positive = (
            "epochs", "batch_size", "micro_batch_size", "learning_rate", "goal_learning_rate_scale", "gradient_clip", "trained_radius_m",
            "max_skipped_in_a_row", "checkpoint_every",
        )  # fmt: skip
        require_positive(self, (*positive, *given(self, ("micro_batch_cost", "context_radius_m"))))
        require_not_negative(self, ("warmup_updates", "weight_decay", *given(self, ("max_trained_agents",))))
        require_finite(self, ("epochs", "learning_rate", "weight_decay"))
        if not 0 <= self.final_learning_rate_share <= 1:
            raise ConfigError(f"final_learning_rate_share is a share in [0, 1], got {self.final_learning_rate_share}.")
        if not 0 <= self.label_smoothing < 1:
            raise ConfigError(f"label_smoothing is a share in [0, 1), got {self.label_smoothing}.")
        if self.label_smoothing_kind == "spatial" and not self.label_smoothing:
            raise ConfigError(
                "label_smoothing_kind=spatial has no effect: set label_smoothing to a share, such as 0.1."
            )

    def num_updates(self, num_scenarios: int) -> int:
        """Optimiser steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(frozen=True, eq=False)
class _Learner:
    """What stays the same from update to update (its tensors do not)."""

    model: nn.Module
    optimizer: torch.optim.Optimizer
    predict: Predict
    scenarios: Scenarios
    costs: Float[np.ndarray, "n"]
    config: ImitationConfig
    fabric: Fabric


def imitate(
    model: nn.Module,
    scenarios: Scenarios,
    out: Path,
    config: ImitationConfig,
    predict: Predict,
    *,
    title: str,
    held_out: Scenarios | None = None,
    card: str = "",
) -> Path:
    """Train the parameters of a model that require a gradient; go on where a run in `out` was stopped.

    Args:
        model: has `save_pretrained`.
        scenarios: with their futures; scenarios without are refused.
        out: the run's folder.
        config: see its fields.
        predict: the model's predictions.
        title: what a person sees beside the progress bar.
        held_out: scenarios to validate on; None = no validation.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: there is no scenario, or the model cannot be validated.
        CheckpointError: `out` holds another run, or the run diverged.
    """
    _refuse_to_train(model, scenarios, config, held_out)
    fabric = start_fabric(config.device)
    run = RunFolder(out, config, describe_inputs(model, scenarios), writes=fabric.is_global_zero)
    model.to(fabric.device).train()
    groups = parameter_groups(model, config.goal_learning_rate_scale)
    optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)
    newest = newest_checkpoint(run.checkpoints)
    done = read_checkpoint(newest, {"policy": model}, optimizer).update if newest else 0
    run.continue_from(done)
    learner = _Learner(model, optimizer, predict, scenarios, scenario_costs(scenarios), config, fabric)
    total, skipped, realism = config.num_updates(len(scenarios)), 0, ""
    with progress_bar(title, total, done) as advance:
        for update in range(done, total):
            start = time.perf_counter()
            set_learning_rate(optimizer, learning_rate(update, total, config))
            values = _update(learner, update)
            values["seconds"] = time.perf_counter() - start
            if held_out is not None and config.validation.is_due(update + 1, total):
                values |= validate(model, held_out, config.validation, fabric)
                realism = f", RMM {values['validation_rmm']:.3f}"
            run.log(update + 1, values)
            skipped = _skipped_in_a_row(skipped, update, values, run, learner)
            if (update + 1) % config.checkpoint_every == 0 or update + 1 == total:
                _keep(update, values, run, learner)
            advance(note=f"loss {values['loss']:.3f}, right {values['accuracy']:.0%}{realism}")
    run.close()
    if fabric.is_global_zero:
        model.eval().save_pretrained(run.model, card=card)  # type: ignore[operator]
    return run.model


def _skipped_in_a_row(before: int, update: int, values: dict[str, float], run: RunFolder, learner: _Learner) -> int:
    """Updates that were skipped up to this one without a good one between; says so, and ends a run that has too many."""
    if math.isfinite(values["gradient_norm"]):
        return 0
    skipped, limit = before + 1, learner.config.max_skipped_in_a_row
    if learner.fabric.is_global_zero:
        in_a_row = f"{skipped} in a row, the run stops at {limit}"
        say(f"update {update + 1} skipped: its gradient is not finite ({in_a_row})")
    if skipped >= limit:
        raise run.diverged(f"the gradients of {skipped} updates in a row are not finite", "lower learning_rate")
    return skipped


def _keep(update: int, values: dict[str, float], run: RunFolder, learner: _Learner) -> None:
    """Write a checkpoint; a run whose loss or weights are lost ends instead."""
    trained = [p for p in learner.model.parameters() if p.requires_grad]
    if not (math.isfinite(values["loss"]) and all(p.isfinite().all() for p in trained)):
        raise run.diverged("the loss or a weight is not finite any more", "lower learning_rate")
    if learner.fabric.is_global_zero:
        write_checkpoint(run.checkpoints, Progress(update + 1), {"policy": learner.model}, learner.optimizer)


def _refuse_to_train(
    model: nn.Module, scenarios: Scenarios, config: ImitationConfig, held_out: Scenarios | None
) -> None:
    """Say before a run what would end it."""
    if not len(scenarios):
        raise ConfigError("no scenario to train on: is the data set empty, or the split misspelt?")
    if config.label_smoothing_kind == "spatial" and not isinstance(getattr(model, "vocabulary", None), Vocabulary):
        raise ConfigError(
            f"{type(model).__name__} has no vocabulary, so nothing is near a token: set label_smoothing_kind=uniform."
        )
    if held_out is not None and config.validation.every:
        refuse_to_validate(model, held_out)


def learning_rate(update: int, total: int, config: ImitationConfig) -> float:
    """Linear warm-up, then a cosine from `learning_rate` to its final share."""
    if update < config.warmup_updates:
        return config.learning_rate * (update + 1) / config.warmup_updates
    share = (update - config.warmup_updates) / max(total - config.warmup_updates, 1)
    low = config.final_learning_rate_share
    return config.learning_rate * (low + 0.5 * (1 - low) * (1 + math.cos(math.pi * share)))


def _update(learner: _Learner, update: int) -> dict[str, float]:
    """One optimiser step: sums of losses over micro batches and processes, divided by the number of predictions."""
    config, fabric = learner.config, learner.fabric
    torch.manual_seed(derive_seed(config.seed, "dropout", update, fabric.global_rank) % 2**63)
    learner.optimizer.zero_grad(set_to_none=True)
    sums = torch.zeros(5, device=fabric.device)  # loss, right, right among the best five, entropy, predictions
    chosen = scenarios_of_update(update, config.batch_size, len(learner.scenarios), config.seed)
    own = own_share(chosen, fabric, learner.costs[chosen].tolist())
    for micro in micro_batches(own, learner.costs, max_count=config.micro_batch_size, max_cost=config.micro_batch_cost):
        batch = batch_with_futures(learner.scenarios, micro, context_radius_m=config.context_radius_m)
        loss, counts = _backward(learner, batch.to(fabric.device), update)
        sums += torch.cat([loss[None], counts])
    sums = add_up(sums, fabric)
    parameters = list(learner.model.parameters())
    add_up_gradients(parameters, fabric)
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad.div_(sums[-1].clamp(min=1))
    norm = torch.nn.utils.clip_grad_norm_(parameters, config.gradient_clip)
    if math.isfinite(float(norm)):
        learner.optimizer.step()
    loss, right, among_five, entropy, predictions = sums.tolist()
    count = max(predictions, 1.0)
    return {
        "loss": loss / count,
        "accuracy": right / count,
        "top5_accuracy": among_five / count,
        "entropy": entropy / count,
        "gradient_norm": float(norm),
        "predictions": predictions,
        "learning_rate": learner.optimizer.param_groups[0]["lr"],
    }


def _backward(learner: _Learner, batch: ScenarioBatch, update: int) -> tuple[Float[Tensor, ""], Float[Tensor, "4"]]:
    """Add the gradient of a micro batch's summed loss; the loss and its counts."""
    config = learner.config
    trained = trained_agents(
        batch, update, radius_m=config.trained_radius_m, limit=config.max_trained_agents, seed=config.seed
    )
    with learner.fabric.autocast():
        prediction = learner.predict(batch, trained, update)
    nearby = learner.model.vocabulary if config.label_smoothing_kind == "spatial" else None
    loss, counts = summed_loss(prediction, config.label_smoothing, nearby)  # type: ignore[arg-type]
    learner.fabric.backward(loss)
    return loss.detach(), counts


def summed_loss(
    prediction: Prediction, label_smoothing: float, nearby: Vocabulary | None = None
) -> tuple[Float[Tensor, ""], Float[Tensor, "4"]]:
    """Summed cross-entropy, and how many predictions were right, right among the best five, the sum of their entropies (nats), and how many were
    made at all. Zeros where nothing counts.

    Args:
        prediction: what was said and what should have been.
        label_smoothing: share of the target that goes elsewhere.
        nearby: it goes to the tokens of this vocabulary near the target; None = evenly to all that exist, the target among them.
    """
    logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]
    log_probs = functional.log_softmax(logits, -1)
    if nearby is None:
        exists = logits > IMPOSSIBLE
        elsewhere = (torch.where(exists, log_probs, 0.0).sum(-1) / exists.sum(-1)).sum()
    else:
        elsewhere = summed_log_prob_nearby(log_probs, target, prediction.class_id[prediction.target_mask], nearby)
    of_target = log_probs.gather(-1, target[:, None])[:, 0]
    loss = -((1 - label_smoothing) * of_target.sum() + label_smoothing * elsewhere)
    best = logits.detach().topk(min(5, logits.shape[-1]), dim=-1).indices == target[:, None]
    entropy = -(log_probs.detach().exp() * log_probs.detach()).sum()
    count = torch.tensor(len(target), device=target.device)
    return loss, torch.stack([best[:, 0].sum(), best.any(-1).sum(), entropy, count]).float()
