"""Learning by imitation: the update that pre-training, CAT-K and goal relabelling share.

The methods differ in the trajectories along which a model predicts tokens: the logged tracks (pre-training), CAT-K
rollouts, or the policy's own rollouts. The loss is the cross-entropy of the target tokens, or a loss that the policy
brings (`ImitatedPolicy`); the sum over all scenarios of an update is divided by the number of predictions.
"""

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError, check_finiteness, check_not_negative, check_positive, check_types, given
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import ImitationLoss, Prediction
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.smoothing import summed_log_prob_nearby
from rlftsim.tokens.vocabulary import STILL_TOKEN, Vocabulary
from rlftsim.training.data import trained_agents
from rlftsim.training.freezing import parameter_groups, set_learning_rate
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.parallel import DeviceConfig, Fabric, all_reduce_gradients, all_reduce_sum
from rlftsim.training.validation import ValidationConfig

IMPOSSIBLE = -1e8
"""A token that cannot be chosen has a smaller logit than this."""


Predict = Callable[[ScenarioBatch, Bool[Tensor, "B A"]], Prediction | ImitationLoss]
"""Predictions of tokens, or a finished loss, both differentiable: for a batch and the agents that count."""


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
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas are decay rates in [0, 1), got {self.betas}.")
        if not 0 <= self.final_lr_ratio <= 1:
            raise ConfigError(f"final_lr_ratio is a fraction in [0, 1], got {self.final_lr_ratio}.")
        if not 0 <= self.mirror_probability <= 1:
            raise ConfigError(f"mirror_probability is a probability in [0, 1], got {self.mirror_probability}.")
        if not 0 < self.still_weight <= 1:
            raise ConfigError(f"still_weight is a weight above 0 and at most 1, got {self.still_weight}.")
        if self.ema_decay is not None and not 0 < self.ema_decay < 1:
            raise ConfigError(f"ema_decay is a fraction between 0 and 1, or None, got {self.ema_decay}.")
        if not 0 <= self.label_smoothing < 1:
            raise ConfigError(f"label_smoothing is a probability in [0, 1), got {self.label_smoothing}.")
        if self.label_smoothing_kind == "spatial" and not self.label_smoothing:
            raise ConfigError("label_smoothing_kind=spatial has no effect: set label_smoothing above 0, such as 0.1.")

    def num_updates(self, num_scenarios: int) -> int:
        """Optimizer steps of the run."""
        return max(math.ceil(self.epochs * num_scenarios / self.batch_size), 1)


@dataclass(eq=False, kw_only=True)
class Imitator(Learner):
    """A model in training, with the state that updates need."""

    num_scenarios: int
    """Training scenarios, all of them."""
    average: nn.Module | None = None
    """Moving average of the weights, as a policy of its own."""
    frozen: Any = None
    """Policy that rolls out in place of the model, where the method has such a policy."""

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Model, average and frozen policy, as far as present."""
        further = {"average": self.average, "frozen": self.frozen}
        return {**super().modules, **{name: module for name, module in further.items() if module is not None}}

    @property
    def result(self) -> Any:
        """The average, if there is an average."""
        return self.policy if self.average is None else self.average

    def finish_update(self, *, is_good: bool) -> None:
        """Take the optimizer's step, and move the average towards the weights."""
        super().finish_update(is_good=is_good)
        if self.average is None or self.config.ema_decay is None or not is_good:
            return
        # Early weights are far off: as long as few updates are made, the average is over about a tenth of them.
        decay = min(self.config.ema_decay, (1 + self.update) / (10 + self.update))
        with torch.no_grad():
            for mean, weight in zip(self.average.state_dict().values(), self.policy.state_dict().values()):
                if mean.is_floating_point():
                    mean.lerp_(weight, 1 - decay)
                else:
                    mean.copy_(weight)


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
        average = None if settings.ema_decay is None else copy.deepcopy(policy).requires_grad_(False)
        return Imitator(
            policy=policy, optimizer=optimizer, config=settings, num_scenarios=len(scenarios), average=average
        )

    def predict(
        self, learner: Imitator, batch: ScenarioBatch, trained: Bool[Tensor, "B A"]
    ) -> Prediction | ImitationLoss:
        """Predictions of tokens, or a finished loss, both differentiable.

        Args:
            learner: Model and settings; the update is `learner.update`.
            batch: Scenarios with futures.
            trained: True = the agent's predictions count.
        """
        raise NotImplementedError

    def update(self, learner: Imitator, scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """An optimizer step along the trajectories of the method."""
        start = time.perf_counter()
        values = update_imitator(learner, scenarios, partial(self.predict, learner), fabric)
        values["seconds"] = time.perf_counter() - start
        accuracy = f", accuracy {values['accuracy']:.0%}" if "accuracy" in values else ""
        return UpdateReport(values, f"loss {values['loss']:.3f}{accuracy}", "its gradient is not finite")


@dataclass(frozen=True)
class PretrainConfig(ImitationConfig):
    """Pre-training. The defaults, which recipes change, are those of the published SMART-tiny on WOMD."""


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


def learning_rate(update: int, total: int, config: ImitationConfig) -> float:
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
    learner: Imitator, scenarios: UpdateScenarios, predict: Predict, fabric: Fabric
) -> dict[str, float]:
    """Metrics of an optimizer step: sums of losses over micro batches and processes, over the number of predictions.

    Args:
        learner: Model and settings, changed in place.
        scenarios: Scenarios of the update that this process works on.
        predict: Predictions of a batch for the agents that count, or the loss.
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
            predicted = predict(batch, trained)
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
