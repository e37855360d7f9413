"""Learning by imitation: the update that pre-training, CAT-K and goal relabelling share.

The methods differ in the trajectories along which a model predicts tokens: the logged tracks (pre-training), CAT-K
rollouts, or the policy's own rollouts. The loss is the cross-entropy of the target tokens, or a loss that the policy
brings (`ImitatedPolicy`); the sum over all scenarios of an update is divided by the number of predictions.
"""

import math
import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import ImitationLoss, Prediction, TokenPolicy
from rlftsim.rollout.rows import find_rows
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.smoothing import summed_log_prob_nearby
from rlftsim.tokens.vocabulary import STILL_TOKEN, Vocabulary, class_of_type
from rlftsim.training.config import DistillConfig, ImitationConfig, PretrainConfig
from rlftsim.training.data import trained_agents
from rlftsim.training.freezing import parameter_groups, set_learning_rate
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.parallel import Fabric, all_reduce_gradients, all_reduce_sum

IMPOSSIBLE = -1e8
"""A token that cannot be chosen has a smaller logit than this."""


@dataclass(eq=False, kw_only=True)
class Imitator(Learner):
    """A model in training, with the state that updates need."""

    num_scenarios: int
    """Training scenarios, all of them."""
    frozen: Any = None
    """Policy that rolls out in place of the model, where the method has such a policy."""

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Model, average and frozen policy, as far as present."""
        return super().modules | ({} if self.frozen is None else {"frozen": self.frozen})


Config = TypeVar("Config", bound=ImitationConfig)


class ImitationMethod(Method[Config]):
    """Base of methods that learn by imitation: a method brings `predict`, and checks in `start`."""

    validates = True

    def start(self, policy: Any, scenarios: Scenarios, settings: Config, fabric: Fabric) -> Imitator:
        """Learner of the policy's parameters that require a gradient.

        Raises:
            ConfigError: The policy has no vocabulary, which spatial label smoothing and a weight of standing tokens
                need.
        """
        if not isinstance(getattr(policy, "vocabulary", None), Vocabulary):
            name = type(policy).__name__
            if settings.label_smoothing_kind == "spatial":
                raise ConfigError(
                    f"{name} has no vocabulary, so nothing is near a token: set label_smoothing_kind=uniform."
                )
            if settings.still_weight != 1.0:
                raise ConfigError(f"{name} has no vocabulary, so no token is known to stand still: set still_weight=1.")
        # Dropout is on: unlike fine-tuning with rewards, imitation has no sampled log-probabilities to reproduce.
        policy.to(fabric.device).train()
        groups = parameter_groups(policy, settings.goal_learning_rate_scale)
        optimizer = torch.optim.AdamW(
            groups, lr=settings.learning_rate, betas=settings.betas, weight_decay=settings.weight_decay
        )
        return Imitator(policy=policy, optimizer=optimizer, config=settings, num_scenarios=len(scenarios))

    @abstractmethod
    def predict(
        self, learner: Imitator, batch: ScenarioBatch, trained: Bool[Tensor, "B A"]
    ) -> Prediction | ImitationLoss:
        """Predictions of tokens, or a finished loss, both differentiable.

        Args:
            learner: Model and settings; the update is `learner.update`.
            batch: Scenarios with futures.
            trained: True = the agent's predictions count.
        """

    def update(self, learner: Imitator, scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """An optimizer step along the trajectories of the method."""
        start = time.perf_counter()
        values = update_imitator(self, learner, scenarios, fabric)
        values["seconds"] = time.perf_counter() - start
        accuracy = f", accuracy {values['accuracy']:.0%}" if "accuracy" in values else ""
        return UpdateReport(values, f"loss {values['loss']:.3f}{accuracy}", "its gradient is not finite")


class PretrainMethod(ImitationMethod[PretrainConfig]):
    """Pre-training: predict the next motion token along logged tracks, or minimize the policy's own loss."""

    settings = PretrainConfig
    title = "pre-train"

    def start(self, policy: Any, scenarios: Scenarios, settings: PretrainConfig, fabric: Fabric) -> Imitator:
        """Learner of a policy that is a PretrainablePolicy or an ImitatedPolicy."""
        check_trainable(policy, scenarios, "pre-training", is_imitated=True)
        return super().start(policy, scenarios, settings, fabric)

    def predict(
        self, learner: Imitator, batch: ScenarioBatch, trained: Bool[Tensor, "B A"]
    ) -> Prediction | ImitationLoss:
        """Predictions or loss along the log."""
        return loss_along_log(learner.policy, batch, trained, learner.update)


def learning_rate(update: int, total: int, config: ImitationConfig | DistillConfig) -> float:
    """Learning rate of an update: linear warm-up, then a cosine down to `final_lr_ratio` of the highest.

    Args:
        update: Number of the update, from 0.
        total: updates of the run.
        config: has the highest rate, the warm-up and the ratio.
    """
    if update < config.warmup_updates:
        return config.learning_rate * (update + 1) / config.warmup_updates
    # 0 after the warm-up; the last update is one step short of 1, so it still learns.
    progress = (update - config.warmup_updates) / max(total - config.warmup_updates, 1)
    low = config.final_lr_ratio
    return config.learning_rate * (low + 0.5 * (1 - low) * (1 + math.cos(math.pi * progress)))


def update_imitator(
    method: ImitationMethod[Any], learner: Imitator, scenarios: UpdateScenarios, fabric: Fabric
) -> dict[str, float]:
    """Metrics of an optimizer step: sums of losses over micro batches and processes, over the number of predictions.

    Args:
        method: Method that predicts tokens, or brings the loss.
        learner: Model and settings, changed in place.
        scenarios: Scenarios of the update that this process works on.
        fabric: Precision of the passes, and processes that sums are added over.
    """
    config, update = learner.config, learner.update
    num_updates = config.num_updates(learner.num_scenarios)
    set_learning_rate(learner.optimizer, learning_rate(update, num_updates, config))
    # Dropout depends on the update and the process alone, so a resumed run draws the same.
    torch.manual_seed(derive_seed(config.seed, "dropout", update, fabric.global_rank) % 2**63)
    learner.optimizer.zero_grad(set_to_none=True)
    nearby = learner.policy.vocabulary if config.label_smoothing_kind == "spatial" else None
    # 1. Gradients of the summed loss add up over micro batches.
    names: list[str] = []  # of further metrics; every micro batch has the same
    sums = torch.zeros((), device=fabric.device)  # becomes [2 + names]: loss, further metrics, number of predictions
    for batch in scenarios.micro_batches(
        config.micro_batch_size, config.micro_batch_cost,
        context_radius_m=config.context_radius_m, mirror_probability=config.mirror_probability,
    ):  # fmt: skip
        trained = trained_agents(
            batch, update, radius_m=config.trained_radius_m, limit=config.max_trained_agents, seed=config.seed
        )
        with fabric.autocast():
            predicted = method.predict(learner, batch, trained)
        # Outside of autocast, where a cross-entropy is in full precision.
        if not isinstance(predicted, ImitationLoss):
            predicted = summed_loss(predicted, config.label_smoothing, nearby, config.still_weight)
        fabric.backward(predicted.loss)
        names = list(predicted.sums)
        values = (predicted.loss, *predicted.sums.values(), predicted.count)
        sums = sums + torch.stack([value.detach().float() for value in values])
    # 2. They add up over processes, and are divided by the number of predictions of the whole batch.
    sums = all_reduce_sum(sums, fabric)
    count = torch.where(sums[-1] > 0, sums[-1], 1.0)  # weights of tokens may add up to less than 1
    parameters = list(learner.policy.parameters())
    all_reduce_gradients(parameters, fabric)
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad.div_(count)
    # 3. The step, skipped where the gradient is not finite.
    norm = float(torch.nn.utils.clip_grad_norm_(parameters, config.gradient_clip))
    learner.finish_update(is_good=math.isfinite(norm))
    return {
        **dict(zip(("loss", *names), (sums[:-1] / count).tolist())),
        "gradient_norm": norm,
        "predictions": float(sums[-1]),
        "learning_rate": learner.optimizer.param_groups[0]["lr"],
    }


def loss_along_log(
    model: Any, batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int
) -> Prediction | ImitationLoss:
    """The model's own imitation loss, or predictions of the next token along logged tracks.

    Args:
        model: PretrainablePolicy or ImitatedPolicy; the loss of an ImitatedPolicy goes first.
        batch: Scenarios with logged futures.
        trained: True = the agent's predictions count.
        update: Number of the update, from 0; draws of an own loss depend on it.
    """
    own_loss = getattr(model, "imitation_loss", None)
    return model.teacher_forced(batch, trained) if own_loss is None else own_loss(batch, trained, update)


def accumulate_imitation(
    model: Any, batches: Sequence[ScenarioBatch], weight: float, fabric: Fabric, *, update: int, seed: int
) -> float:
    """Set the model's gradient to the gradient of `weight` times the mean pre-training loss along the log.

    Goes before all other additions to the gradient: the mean is over the predictions of all processes, the number of
    which is known only at the end, so the accumulated gradient is scaled then.

    Args:
        model: Model with zero gradients, as `loss_along_log` takes it.
        batches: this process's scenarios, with futures; all agents with a future count.
        weight: Weight of the loss in the objective.
        fabric: precision, and the processes that the mean is over.
        update: Number of the update, from 0.
        seed: Seed of the draws of an own loss; determines the draws together with update and process.

    Returns:
        The mean loss, nats per prediction for policies over tokens.
    """
    torch.manual_seed(derive_seed(seed, "imitation", update, fabric.global_rank) % 2**63)
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)  # loss, number of predictions
    for batch in batches:
        all_agents = trained_agents(batch, update, radius_m=math.inf, limit=None, seed=0)
        with fabric.autocast():
            predicted = loss_along_log(model, batch, all_agents, update)
        if not isinstance(predicted, ImitationLoss):
            predicted = summed_loss(predicted, label_smoothing=0.0)
        fabric.backward(predicted.loss)
        sums += torch.stack([predicted.loss.detach().double(), predicted.count.double()])
    total, count = all_reduce_sum(sums, fabric).tolist()
    for parameter in model.parameters():
        if parameter.grad is not None:
            parameter.grad.mul_(weight / max(count, 1.0))
    return total / max(count, 1.0)


def summed_loss(
    prediction: Prediction, label_smoothing: float, nearby: Vocabulary | None = None, still_weight: float = 1.0
) -> ImitationLoss:
    """Cross-entropy of tokens summed over predictions, nats, with the sums for metrics.

    Args:
        prediction: logits and targets; only entries marked by the target mask count.
        label_smoothing: probability that the target gives to other tokens.
        nearby: vocabulary whose tokens near the target get that probability; None = all tokens that exist, the target
            included.
        still_weight: weight of predictions whose target is token 0, which stands still in a vocabulary; all other
            predictions count 1.

    Returns:
        The loss and the number of predictions; the top-1 hits, the top-5 hits and the entropy (nats) by the names of
        the means. All are sums over predictions times weights, and zero where no prediction counts.
    """
    logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]  # [r, V], [r]
    log_probs = functional.log_softmax(logits, -1)
    measured_log_probs = log_probs.detach()
    weight = torch.where(target == STILL_TOKEN, still_weight, 1.0)  # [r]
    if still_weight != 1.0:
        # Weighted targets teach probabilities in proportion to weight times probability. They are compared with what
        # the model would say of such data, so that its own probability of standing stays that of the data: else parked
        # cars set off.
        prior = torch.zeros(logits.shape[-1], device=logits.device)  # [V]
        prior[STILL_TOKEN] = math.log(still_weight)
        log_probs = functional.log_softmax(log_probs + prior, -1)
    if nearby is None:
        # Impossible tokens have log-probabilities of about -1e8, which would swamp the mean.
        exists = logits > IMPOSSIBLE
        elsewhere = (weight * torch.where(exists, log_probs, 0.0).sum(-1) / exists.sum(-1)).sum()
    else:
        class_id = prediction.class_id[prediction.target_mask]
        elsewhere = summed_log_prob_nearby(weight[:, None] * log_probs, target, class_id, nearby)
    # Uniform smoothing spreads over all existing tokens, the target included, as torch's cross_entropy does.
    of_target = log_probs.gather(-1, target[:, None])[:, 0]
    loss = -((1 - label_smoothing) * (weight * of_target).sum() + label_smoothing * elsewhere)
    hits = logits.detach().topk(min(5, logits.shape[-1]), dim=-1).indices == target[:, None]  # [r, 5]
    entropy = -(measured_log_probs.exp() * measured_log_probs).sum(-1)
    measured = {"accuracy": hits[:, 0], "top5_accuracy": hits.any(-1), "entropy": entropy}  # [r] each
    sums = {name: (weight * values).sum() for name, values in measured.items()}
    return ImitationLoss(loss, weight.sum(), sums)


# ---- closed loop ---------------------------------------------------------------------------------------------------


@runtime_checkable
class TokenLogits(Protocol):
    """The part of a distribution over tokens that imitation needs."""

    logits: Float[Tensor, "R V"]
    """Of the R elements where the mask is True, in the mask's order."""
    mask: Bool[Tensor, "B N A *L"]


@dataclass(frozen=True, eq=False)
class TargetedRollouts:
    """Rollouts with a target for each decision."""

    rollouts: Rollouts
    target: Int64[Tensor, "B N A L"]
    """Token that should have been chosen."""
    target_mask: Bool[Tensor, "B N A L"]
    """True = there is a target."""
    object_type: Int64[Tensor, "B A"]
    """Type of each agent, which decides the class that its token ids refer to."""


def predict_targets(
    policy: TokenPolicy, context: Any, targeted: TargetedRollouts, trained: Bool[Tensor, "B A"]
) -> Prediction:
    """Predictions along rollouts: differentiable, in a single parallel pass.

    Args:
        policy: the policy that rolled out.
        context: the policy's encoding of the same scenarios.
        targeted: the rollouts with targets.
        trained: True = the agent's decisions count.
    """
    dist: TokenLogits = policy.score(context, targeted.rollouts)  # type: ignore[assignment]
    counts = targeted.target_mask & targeted.rollouts.decision_mask & trained[:, None, :, None]  # [B, N, A, L]
    class_id = class_of_type(targeted.object_type)[:, None, :, None].expand(counts.shape)
    # The distribution has a row for each element of its mask only: pick the same ones, in the same order.
    rows = find_rows(dist.mask, is_dense=len(dist.logits) == dist.mask.numel())
    return Prediction(dist.logits, *(values[rows] for values in (targeted.target, counts, class_id)))
