"""Pre-training: predict the next motion token along recorded tracks."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError, require_positive
from rlftsim.progress import progress_bar
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, Scenarios
from rlftsim.training.checkpoint import Progress, newest_checkpoint, read_checkpoint, write_checkpoint
from rlftsim.training.data import batch_with_futures, scenarios_of_update
from rlftsim.training.parallel import DeviceConfig, add_up, add_up_gradients, own_share, start_fabric
from rlftsim.training.run_folder import RunFolder, describe_inputs

IMPOSSIBLE = -1e8
"""A token that cannot be chosen has a smaller logit than this."""


@runtime_checkable
class Prediction(Protocol):
    """What a model says along recorded tracks, and what it should have said."""

    @property
    def logits(self) -> Float[Tensor, "R V"]:
        """Of R predictions, over the vocabulary."""
        ...

    @property
    def target(self) -> Int64[Tensor, "R"]:
        """Token that came next."""
        ...

    @property
    def target_mask(self) -> Bool[Tensor, "R"]:
        """True = the prediction counts."""
        ...


@runtime_checkable
class NextTokenModel(Protocol):
    """A model that can be pre-trained."""

    def teacher_forced(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predictions of the next token of every agent at every step of its recorded track."""
        ...

    def save_pretrained(self, folder: Path, *, card: str = "") -> None:
        """Write the model into a folder."""
        ...


@dataclass(frozen=True)
class PretrainConfig:
    """How a model is pre-trained. The defaults are those of the published SMART-tiny on WOMD."""

    epochs: float = 32.0
    """Passes over the training scenarios."""
    batch_size: int = 80
    """Scenarios per update, over all processes."""
    micro_batch_size: int = 8
    """Scenarios in memory at once; gradients add up over the rest."""
    learning_rate: float = 5e-4
    final_learning_rate_share: float = 0.01
    """The learning rate falls to this share along a cosine."""
    warmup_updates: int = 0
    weight_decay: float = 0.01
    gradient_clip: float = 0.5
    label_smoothing: float = 0.1
    """The loss of a perfect model is then not zero."""
    trained_radius_m: float = 100.0
    """Agents farther from the ego at the current step are context only."""
    max_trained_agents: int | None = 32
    """Of a scenario; the evaluated ones first, the rest at random. None = all."""
    max_skipped_in_a_row: int = 5
    """An update whose gradient is not finite is skipped; after so many in a row the run stops."""
    checkpoint_every: int = 200
    """Updates."""
    seed: int = 0
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        require_positive(self, ("epochs", "batch_size", "micro_batch_size", "learning_rate", "checkpoint_every"))
        if not 0 <= self.label_smoothing < 1:
            raise ConfigError(f"label_smoothing is a share in [0, 1), got {self.label_smoothing}.")

    def num_updates(self, num_scenarios: int) -> int:
        """Optimiser steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


def pretrain(model: NextTokenModel, scenarios: Scenarios, out: Path, config: PretrainConfig, *, card: str = "") -> Path:
    """Pre-train a model in place; go on where a run in `out` was stopped.

    Args:
        model: an nn.Module that is a NextTokenModel.
        scenarios: with their futures; scenarios without are refused.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the model cannot be pre-trained, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
    """
    if not isinstance(model, nn.Module) or not isinstance(model, NextTokenModel):
        raise ConfigError(f"{type(model).__name__} cannot be pre-trained: it needs teacher_forced and save_pretrained.")
    if not len(scenarios):
        raise ConfigError("no scenario to train on: is the data set empty, or the split misspelt?")
    fabric = start_fabric(config.device)
    run = RunFolder(out, config, describe_inputs(model, scenarios), writes=fabric.is_global_zero)
    model.to(fabric.device).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    newest = newest_checkpoint(run.checkpoints)
    done = read_checkpoint(newest, {"policy": model}, optimizer).update if newest else 0
    run.continue_from(done)
    total, skipped = config.num_updates(len(scenarios)), 0
    with progress_bar("pre-train", total, done) as advance:
        for update in range(done, total):
            start = time.perf_counter()
            _set_learning_rate(optimizer, learning_rate(update, total, config))
            values = _update(model, optimizer, scenarios, update, config, fabric)
            run.log(update + 1, {**values, "seconds": time.perf_counter() - start})
            skipped = 0 if math.isfinite(values["gradient_norm"]) else skipped + 1
            if skipped >= config.max_skipped_in_a_row:
                raise run.diverged(f"the gradients of {skipped} updates in a row are not finite", "lower learning_rate")
            if fabric.is_global_zero and ((update + 1) % config.checkpoint_every == 0 or update + 1 == total):
                write_checkpoint(run.checkpoints, Progress(update + 1), {"policy": model}, optimizer)
            advance(note=f"loss {values['loss']:.3f}, right {values['accuracy']:.0%}")
    run.close()
    if fabric.is_global_zero:
        model.eval().save_pretrained(run.model, card=card)
    return run.model


def learning_rate(update: int, total: int, config: PretrainConfig) -> float:
    """Linear warm-up, then a cosine from `learning_rate` to its final share."""
    if update < config.warmup_updates:
        return config.learning_rate * (update + 1) / config.warmup_updates
    share = (update - config.warmup_updates) / max(total - config.warmup_updates, 1)
    low = config.final_learning_rate_share
    return config.learning_rate * (low + 0.5 * (1 - low) * (1 + math.cos(math.pi * share)))


def _set_learning_rate(optimizer: torch.optim.Optimizer, value: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = value


def _update(
    model: NextTokenModel,
    optimizer: torch.optim.Optimizer,
    scenarios: Scenarios,
    update: int,
    config: PretrainConfig,
    fabric: Fabric,
) -> dict[str, float]:
    """One optimiser step: sums of losses over micro batches and processes, divided by the number of predictions."""
    assert isinstance(model, nn.Module)
    torch.manual_seed(derive_seed(config.seed, "dropout", update, fabric.global_rank) % 2**63)
    optimizer.zero_grad(set_to_none=True)
    sums = torch.zeros(4, device=fabric.device)  # loss, right, right among the best five, predictions
    chosen = own_share(scenarios_of_update(update, config.batch_size, len(scenarios), config.seed), fabric)
    for micro in _pieces(chosen, config.micro_batch_size):
        batch = batch_with_futures(scenarios, micro).to(fabric.device)
        trained = trained_agents(batch, config, update)
        with fabric.autocast():
            prediction = model.teacher_forced(batch, trained)
        loss, counts = _loss(prediction, config.label_smoothing)
        fabric.backward(loss)
        sums += torch.cat([loss.detach()[None], counts])
    sums = add_up(sums, fabric)
    parameters = [p for p in model.parameters() if p.grad is not None]
    add_up_gradients(parameters, fabric)
    for parameter in parameters:
        parameter.grad.div_(sums[3].clamp(min=1))  # type: ignore[union-attr]
    norm = torch.nn.utils.clip_grad_norm_(parameters, config.gradient_clip)
    if math.isfinite(float(norm)):
        optimizer.step()
    loss, right, among_five, count = sums.tolist()
    count = max(count, 1.0)
    return {
        "loss": loss / count,
        "accuracy": right / count,
        "top5_accuracy": among_five / count,
        "gradient_norm": float(norm),
        "predictions": count,
        "learning_rate": optimizer.param_groups[0]["lr"],
    }


def _pieces(items: list[int], size: int) -> Iterator[list[int]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]


def _loss(prediction: Prediction, label_smoothing: float) -> tuple[Float[Tensor, ""], Float[Tensor, "3"]]:
    """Summed cross-entropy (smoothed over the tokens that exist), and how many predictions were right, right among the best
    five, and made at all."""
    logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]
    log_probs = functional.log_softmax(logits, -1)
    exists = logits > IMPOSSIBLE
    elsewhere = torch.where(exists, log_probs, 0.0).sum(-1) / exists.sum(-1)
    of_target = log_probs.gather(-1, target[:, None])[:, 0]
    loss = -((1 - label_smoothing) * of_target + label_smoothing * elsewhere).sum()
    best = logits.detach().topk(min(5, logits.shape[-1]), dim=-1).indices == target[:, None]
    return loss, torch.stack(
        [best[:, 0].sum(), best.any(-1).sum(), torch.tensor(len(target), device=target.device)]
    ).float()


def trained_agents(batch: ScenarioBatch, config: PretrainConfig, update: int) -> Bool[Tensor, "B A"]:
    """Agents whose predictions count: the evaluated and interesting ones, then those near the ego with a future, up to a limit.

    Who is drawn depends on the seed, the update and the scenario, not on how a batch is put together.
    """
    now, future = CURRENT_STEP, slice(CURRENT_STEP + 1, None)
    ego = torch.tensor([s.tracks.object_id[s.ego_index] for s in batch.scenarios], device=batch.device)
    interest = torch.zeros_like(batch.agent_mask)
    for row, scenario, ids in zip(interest, batch.scenarios, batch.object_id):
        row |= torch.isin(ids, torch.from_numpy(scenario.objects_of_interest).to(ids.device))
    first = (batch.evaluated_mask | interest) & batch.agent_mask
    ego_position = (batch.position[:, :, now] * (batch.object_id == ego[:, None])[..., None]).sum(1, keepdim=True)
    near = (batch.position[:, :, now] - ego_position).norm(dim=-1) < config.trained_radius_m
    others = near & (batch.valid[:, :, future].sum(-1) >= 5) & batch.agent_mask & ~first
    if config.max_trained_agents is None:
        return first | others
    luck = torch.zeros(others.shape)
    for row, scenario in zip(luck, batch.scenarios):
        seed = derive_seed(config.seed, "agents", update, scenario.scenario_id)
        generator = torch.Generator().manual_seed(seed % 2**63)
        count = len(scenario.simulated_indices)
        row[:count] = torch.rand(count, generator=generator)
    luck = luck.to(batch.device)
    order = torch.where(others, luck, 2.0).argsort(-1).argsort(-1)
    return first | (others & (order < config.max_trained_agents - first.sum(-1, keepdim=True)))
