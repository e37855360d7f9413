"""The interface between a traffic model and the rest of the package. To add a model, read this page and write a class.

`Policy` is all that simulation, the metric and evaluation need: five methods and three numbers. Each protocol further
down is optional and opens a further door:

| a policy that implements | can be |
|---|---|
| `Policy` | simulated, scored, evaluated |
| `TrainablePolicy` (an nn.Module) | fine-tuned with rewards, saved, loaded by folder |
| `PartlyTrainedPolicy` | fine-tuned in chosen parts, with the rest frozen |
| `PolicyWithHead` | fine-tuned in its last layers alone |
| `SharingPolicy` | fine-tuned faster, because passes over the same scenarios share features |
| `RelitPolicy` | simulated for longer than 8 s without encoding maps anew whenever lights change |
| `PretrainablePolicy` | pre-trained on logged tracks, token by token |
| `ImitatedPolicy` | pre-trained on logged tracks with a special loss |
| `CalibratablePolicy` | calibrated: a few named features of states and decisions get weights |
| `TokenPolicy` | fine-tuned in closed loop on tokens (CAT-K, goal relabelling), made calibratable |
| `ActionPolicy` | made calibratable, with continuous actions |
| `GoalConditionedPolicy` | given goals, and trained on goals |
| `ConditionablePolicy` | made goal-conditioned, where a run with goals starts from a goal-free model |

`policies.registry` gives a policy a name, and `rollout.check.check_policy` tests the contract.

Differences from a classical policy API, each for a reason:

* A policy holds weights only. States are values, so policy and reference can run side by side and rollouts can
  interleave.
* Randomness is handed in as uniform noise, a few values for every (scenario, rollout, agent, decision), drawn from the
  seed and the id of the scenario (`rollout.noise`). So the same seed gives the same rollouts however a batch is
  composed, sliced or moved between devices, and no random state has to be stored to resume a run.
* A batch holds the logged future, which training learns from. `encode` may not read the future: rollouts are those of a
  test split, in which tracks and lights end at the current step.

A policy that is an nn.Module is used in these modes. `policies.registry.load_policy` returns evaluation mode with
`requires_grad` False everywhere. Imitation of the log (pre-training, CAT-K) trains in `.train()`, so dropout is active.
Fine-tuning with rewards and goal relabeling train in `.eval()`: dropout would change the probabilities of decisions
between rollout and score.

Shapes: B scenarios, N rollouts, A agents, L decisions, t steps of 0.1 s per decision, V tokens, R selected elements.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.errors import ConfigError, check_types
from rlftsim.goals.types import Goals
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.vocabulary import Vocabulary

AnyPolicy = TypeVar("AnyPolicy")
MIN_TEMPERATURE = 1e-30
"""Lower ones than this make logits infinite in float32."""


@dataclass(frozen=True)
class Sampling:
    """Temperature and truncation of the draws. RL samples with the defaults, so that the estimator is unbiased.

    A model may have a sampling of its nature, as those trained with label smoothing need it. That is a part of what it
    is: draws, log-probability, KL and entropy are under it, and a second one narrows it.
    """

    temperature: float = 1.0
    """Below 1 likely decisions become likelier, as the density is raised to 1 / temperature; 0 always takes the most
    likely one, of continuous actions the mean."""
    top_k: int | None = None
    """Keep only this many of the most likely decisions; None keeps all."""

    def __post_init__(self) -> None:
        check_types(self)
        if not (self.temperature == 0 or MIN_TEMPERATURE <= self.temperature < math.inf):
            raise ConfigError(
                f"sampling temperature must be >= 0 and finite, and not below {MIN_TEMPERATURE:g} unless it is 0, got "
                f"{self.temperature}: 1 samples, 0 takes the mode."
            )
        if self.top_k is not None and self.top_k < 1:
            raise ConfigError(f"sampling top_k must be >= 1, got {self.top_k}: leave it out to keep all decisions.")

    @property
    def is_full(self) -> bool:
        """True if the whole, untempered distribution is sampled."""
        return self.temperature == 1.0 and self.top_k is None

    def narrow(self, sampling: "Sampling") -> "Sampling":
        """Both at once: the product of the temperatures, and the smaller number of decisions."""
        top_k = min((k for k in (self.top_k, sampling.top_k) if k is not None), default=None)
        return Sampling(self.temperature * sampling.temperature, top_k)


@runtime_checkable
class DecisionDistribution(Protocol):
    """An independent distribution per leading element, float32, nats.

    Leading axes are [B, N, A] while simulating and [B, N, A, L] when scored. `policies.distributions.TokenDistribution`
    is for decisions that are token ids.

    There may be a `mask` of the leading axes. Where False the agent makes no decision, such as padding or an agent that
    has left the map: log-probability, KL and entropy are 0 there and left out of every mean.
    """

    def sample(self, sampling: Sampling, noise: Float[Tensor, "... noise"]) -> Tensor:
        """Draw decisions, without gradient.

        Args:
            sampling: Temperature and truncation of the draw; the defaults draw from the full distribution.
            noise: Uniform numbers in [0, 1), `Policy.noise_size` per element.

        Returns:
            Decisions [..., *event].
        """
        ...

    def log_prob(self, decision: Tensor, sampling: Sampling = Sampling()) -> Float[Tensor, "..."]:
        """Log-probability under the distribution that `sampling` draws from.

        Args:
            decision: Decisions [..., *event]; the event axes are summed over.
            sampling: Temperature and truncation that the decisions were drawn with.
        """
        ...

    def kl(self, reference: Any) -> Float[Tensor, "..."]:
        """KL(self || reference) in closed form, between full distributions of the same kind."""
        ...

    def entropy(self) -> Float[Tensor, "..."]:
        """Entropy of the full distribution."""
        ...


@dataclass(frozen=True, eq=False)
class DecisionStatistics:
    """Three numbers of each element that an update of fine-tuning is made of, float32, nats; 0 for padding."""

    log_prob: Float[Tensor, "..."]
    """Of the decision."""
    kl: Float[Tensor, "..."]
    """From the policy's distribution to the reference's."""
    entropy: Float[Tensor, "..."]


@runtime_checkable
class StatisticsDistribution(Protocol):
    """A distribution that computes the statistics in one pass. Optional: saves memory and time, changes no number.

    For any other `DecisionDistribution` the statistics come from `log_prob`, `kl` and `entropy`.
    """

    def statistics(self, decision: Tensor, reference: Any) -> DecisionStatistics:
        """Log-probability of a decision, KL(self || reference) and entropy, with gradient.

        Args:
            decision: Decisions [..., *event], drawn from the full distribution without truncation.
            reference: Distribution of the same kind and elements; receives no gradient.
        """
        ...


def compute_statistics(distribution: DecisionDistribution, decision: Tensor, reference: Any) -> DecisionStatistics:
    """Statistics of any distribution, in one pass for a `StatisticsDistribution`.

    Args:
        distribution: Distribution of the policy that is trained.
        decision: Decisions [..., *event], drawn from the full distribution without truncation.
        reference: Distribution of the same kind and elements that the KL divergence is measured from.
    """
    if isinstance(distribution, StatisticsDistribution):
        return distribution.statistics(decision, reference)
    return DecisionStatistics(distribution.log_prob(decision), distribution.kl(reference), distribution.entropy())


@runtime_checkable
class Policy(Protocol):
    """A model that decides for all agents of a scenario.

    Contexts and states are opaque values of the policy's classes, except that a state has two attributes:

    * `poses` [B, N, A, t, 3]: x, y, heading of the steps of the last decision in the map frame; None before the first.
    * `draws` [B, N, ...]: values that `begin` drew from the noise, once per rollout; None for most policies. A single
      tensor, which all other code slices along B and N and hands back to `score` as `Rollouts.draws`. Several values
      are packed along the last axis: 16 latent numbers and the index of a destination per agent are float32
      [B, N, A, 17], where integers are exact up to 2^24. Log-probabilities are conditional on the draws, and the
      draws are not rewarded: training changes decisions given a latent, not how latents are drawn.
    """

    steps_per_decision: int
    """Steps of 0.1 s that a decision lasts; divides 80."""
    noise_size: int
    """Uniform numbers per agent that a decision consumes (0 = deterministic)."""
    initial_noise_size: int
    """Uniform numbers per agent that `begin` consumes."""

    def encode(self, scenarios: ScenarioBatch) -> Any:
        """Context of a batch: map, lights, history. Computed once per scenario and shared by all rollouts."""
        ...

    def begin(self, context: Any, num_rollouts: int, goals: Goals | None, noise: Float[Tensor, "B N A k"]) -> Any:
        """State of N simulations at the current step.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            num_rollouts: Number N of simulations of each scenario, all in a single state.
            goals: Goals of agents in each rollout; None = goal-free. A policy that cannot follow goals ignores this.
            noise: Uniform numbers in [0, 1), `initial_noise_size` per agent.
        """
        ...

    def decide(self, context: Any, state: Any) -> DecisionDistribution:
        """Distributions [B, N, A] of the next decision.

        Log-probability, KL and entropy of padding are exactly 0.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            state: State of N simulations before the decision, from `begin` or `advance`.
        """
        ...

    def advance(self, context: Any, state: Any, decision: Tensor, forced: AgentStates | None = None) -> Any:
        """State after a decision: kinematics only, no network.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            state: State of N simulations before the decision, from `begin` or `advance`.
            decision: Decisions [B, N, A, *event].
            forced: States [B, N, A, t] imposed from outside; None = none. An agent whose forced states are all valid is
                put into these states, whatever the decision.
        """
        ...

    def score(self, context: Any, rollouts: Rollouts) -> DecisionDistribution:
        """Distributions [B, N, A, L] that `decide` gives along rollouts; differentiable, in one parallel pass.

        Args:
            context: Context of the same scenarios, from `encode`.
            rollouts: Decisions, forced states, goals and draws of a simulation, whichever policy decided in it.
        """
        ...


# ---- optional: weights
# ---------------------------------------------------------------------------------------------------


@runtime_checkable
class SavedPolicy(Protocol):
    """A model that can be written into a folder, as `policies.checkpoint` does in a line."""

    def save_pretrained(self, folder: Path, *, card: str = "") -> None:
        """Write the model into a folder.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of the folder's README.md, where training describes the data and settings.
        """
        ...


@runtime_checkable
class TrainablePolicy(Policy, SavedPolicy, Protocol):
    """A policy with weights, an nn.Module. Needed by every training method.

    A class that is to be loaded by folder is a `LoadablePolicy`, too.
    """


@runtime_checkable
class LoadablePolicy(Protocol):
    """Class of policies that are found by the architecture name in a model folder's config.json.

    Stored evaluations and runs know a policy by the fingerprint (`rollout.fingerprint`), a hash of weights, public
    settings and the name of the class. That name is `architecture` of the very class, so the class may be moved or
    renamed. A class of nested settings, such as a dataclass in `self.config`, declares a name as
    `fingerprint_name: ClassVar[str]`; without that name the class is known by module and name, and cannot be moved. A
    policy that holds a second policy declares `fingerprint_parts: ClassVar[tuple[str, ...]]`, names of submodules whose
    settings count as well.
    """

    architecture: ClassVar[str]
    """Name in `policies.registry.POLICIES`."""

    @classmethod
    def from_pretrained(cls, folder: Any) -> Policy:
        """Policy of a model folder, as `save_pretrained` wrote it."""
        ...


@runtime_checkable
class PartlyTrainedPolicy(Protocol):
    """A policy with parts that fine-tuning leaves alone. Without this, all weights are trained."""

    def fine_tuned_modules(self) -> tuple[nn.Module, ...]:
        """Submodules to be trained by default; all other submodules are frozen unless `trained="all"`."""
        ...


@runtime_checkable
class PolicyWithHead(Protocol):
    """A policy that can be fine-tuned in the last layers alone, by `trained="head"`: for few rollouts."""

    def head_modules(self) -> tuple[nn.Module, ...]:
        """Submodules to be trained; the features that these layers decide by stay as before."""
        ...


# ---- optional: passes over the same scenarios
# ---------------------------------------------------------------------------


@runtime_checkable
class SharingPolicy(Policy, Protocol):
    """A policy that computes once the features that several passes over the same scenarios have in common.

    An update of fine-tuning encodes the scenarios for the rollout, for the policy and for the reference, and scores the
    rollouts under policy and reference. The policy compares weights to tell which features are equal. The results are
    those of `encode` and `score`.
    """

    def encode_like(self, scenarios: ScenarioBatch, context: Any) -> Any:
        """`encode(scenarios)`, taking over from a context the features that this policy would compute alike.

        Args:
            scenarios: Scenarios that `context` was encoded from, in the same order.
            context: Context from any policy whose weights have not been changed since; None = no features to take over.
        """
        ...

    def score_with_reference(
        self, context: Any, rollouts: Rollouts, reference: Any, ref_context: Any, ref_rollouts: Rollouts
    ) -> tuple[DecisionDistribution, DecisionDistribution]:
        """`score` of this policy, and without gradient of a reference.

        Args:
            context: Context of the scenarios under this policy.
            rollouts: Rollouts of the same scenarios that this policy scores.
            reference: Policy of any class, scored without gradient.
            ref_context: Context of the scenarios under the reference.
            ref_rollouts: The same object as `rollouts`, or the same rollouts under other goals.
        """
        ...


def encode_like(policy: Policy, scenarios: ScenarioBatch, context: Any) -> Any:
    """Context of scenarios that have been encoded before; parts are shared where the policy is a `SharingPolicy`.

    Args:
        policy: Policy of any class that encodes the scenarios.
        scenarios: Scenarios that `context` was encoded from, in the same order.
        context: Context from any policy whose weights have not been changed since; None = no features to take over.
    """
    return policy.encode_like(scenarios, context) if isinstance(policy, SharingPolicy) else policy.encode(scenarios)


def score_with_reference(
    policy: Policy, context: Any, rollouts: Rollouts, reference: Policy, ref_context: Any, ref_rollouts: Rollouts
) -> tuple[DecisionDistribution, DecisionDistribution]:
    """Distributions along rollouts under a policy and, without gradient, under a reference.

    Args:
        policy: Policy of any class; a `SharingPolicy` shares features with the reference.
        context: Context of the scenarios under the policy.
        rollouts: Rollouts of the same scenarios that the policy scores.
        reference: Policy of any class, scored without gradient.
        ref_context: Context of the scenarios under the reference.
        ref_rollouts: The same object as `rollouts`, or the same rollouts under other goals.
    """
    if isinstance(policy, SharingPolicy):
        return policy.score_with_reference(context, rollouts, reference, ref_context, ref_rollouts)
    dist = policy.score(context, rollouts)
    with torch.no_grad():
        return dist, reference.score(ref_context, ref_rollouts)


@runtime_checkable
class RelitPolicy(Policy, Protocol):
    """A policy that keeps what does not depend on traffic lights where these change, from second 8 on."""

    def relight(self, context: Any, scenarios: ScenarioBatch) -> Any:
        """`encode(scenarios)` for decisions of rollouts that have begun; the context where it sees the same lights.

        Args:
            context: Context of the same scenarios with other lights, from `encode` or `relight`.
            scenarios: Scenarios, with the step of the lights that are seen.
        """
        ...


def relight(policy: Policy, context: Any, scenarios: ScenarioBatch) -> Any:
    """Context of scenarios with other traffic lights, encoded anew where the policy is no `RelitPolicy`.

    Args:
        policy: Policy that encoded the context.
        context: Context of the same scenarios with other lights.
        scenarios: Scenarios, with the step of the lights that are seen.
    """
    return policy.relight(context, scenarios) if isinstance(policy, RelitPolicy) else policy.encode(scenarios)


# ---- optional: tokens
# ----------------------------------------------------------------------------------------------------


@runtime_checkable
class TokenPolicy(Policy, Protocol):
    """A policy whose decisions are token ids of a vocabulary.

    The distributions are dataclasses with `mask` and `logits` [R, V] of the R elements where the mask is True, in the
    mask's order.
    """

    vocabulary: Vocabulary


@runtime_checkable
class ActionPolicy(Policy, Protocol):
    """A policy whose decisions are continuous actions; the distributions are `distributions.GaussianDistribution`s."""

    def predict_pose(
        self, class_id: Int64[Tensor, "*#g"], speed: Float[Tensor, "*#g"], action: Float[Tensor, "*g D"], seconds: float
    ) -> Float[Tensor, "*g 3"]:
        """Where an action leads that is kept up: x, y and heading in the agent's frame, meters and radians.

        Args:
            class_id: 0 vehicle, 1 pedestrian, 2 cyclist; as the speed of a shape that broadcasts, such as [R, 1].
            speed: Speeds of the agents, m/s, negative backwards.
            action: Actions, as the distributions draw these, such as [R, actions, D].
            seconds: Time from now.
        """
        ...


@runtime_checkable
class CalibratablePolicy(SavedPolicy, Policy, Protocol):
    """A policy with a weighted sum of named features on the log-probabilities; made of a policy of tokens or actions by
    `policies.calibrated.policy.add_features`.

    The distributions also have `with_eta(eta)`, the distribution with other weights, and `score_function(decision)`,
    the gradient [..., K] of the log-probability by the K weights.
    """

    eta: nn.Parameter
    """Weights of the features, [K]."""
    features: tuple[str, ...]
    """Names of the features."""

    def set_calibration(self, eta: Tensor, calibration: Mapping[str, Any]) -> None:
        """Take fitted weights, and a record of the fit as values that JSON has, to be saved with the weights.

        Args:
            eta: Weights in the order of the features.
            calibration: Table of each feature's gain, and measured changes.
        """
        ...


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted next tokens of R elements and the tokens that should come next: input of a cross-entropy."""

    logits: Float[Tensor, "R V"]
    """Logits over the vocabulary."""
    target: Int64[Tensor, "R"]
    """Token that should come next."""
    target_mask: Bool[Tensor, "R"]
    """True = the prediction counts."""
    class_id: Int64[Tensor, "R"]
    """Agent class that each row's token ids refer to."""


@runtime_checkable
class PretrainablePolicy(SavedPolicy, Protocol):
    """A model that learns to predict the next token along logged tracks."""

    def teacher_forced(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predictions of the next token of every agent at every step of the logged track.

        Args:
            scenarios: Scenarios with logged futures, the targets of imitation.
            trained: True = the agent's predictions count; other agents are context.
        """
        ...


# ---- optional: goals
# -----------------------------------------------------------------------------------------------------


@runtime_checkable
class GoalConditionedPolicy(Policy, Protocol):
    """A policy that can be given goals. An agent without a goal must decide exactly as in a goal-free policy."""

    is_goal_conditioned: bool
    """True if goals have an effect. False lets a class implement this protocol with models that follow no goals."""

    def goal_modules(self) -> tuple[nn.Module, ...]:
        """Submodules that only goals use: `trained="goals"` trains these alone, with a scaled learning rate.

        Empty in a model that is not goal-conditioned.
        """
        ...

    def with_guidance(self, scale: float) -> "GoalConditionedPolicy":
        """Copy that follows goals more closely (scale > 1) or less (< 1) than was learned; the same policy at 1.

        Args:
            scale: Factor of the pull towards goals, at least 0.

        Raises:
            ConfigError: This model has no goal pull that could be scaled.
        """
        ...


@runtime_checkable
class ConditionablePolicy(Protocol):
    """A policy that goal conditioning can be added to, before training with goals."""

    def with_goal_conditioning(self, encoding: Any, *, logit_bias: bool | None = None) -> GoalConditionedPolicy:
        """Copy with fresh weights for goals, without effect yet; the same policy if conditioned in this way already.

        Args:
            encoding: Name of an encoding of goals that the policy defines; SMART has "concat" and "indication".
            logit_bias: True adds a goal-progress bias to the logits of decisions; None = the policy's default.

        Raises:
            ConfigError: There is no such encoding, or the policy is conditioned in a different way.
        """
        ...


# ---- questions about any policy
# ------------------------------------------------------------------------------------------


def get_device(policy: object) -> torch.device:
    """Device of a policy's weights; the CPU for a policy without any."""
    weights = policy.parameters() if isinstance(policy, nn.Module) else ()
    return next((w.device for w in weights), torch.device("cpu"))


def frozen_copy(policy: AnyPolicy) -> AnyPolicy:
    """A copy without dropout and gradients, so that tables of weights stay valid; the policy if without weights."""
    return copy.deepcopy(policy).eval().requires_grad_(False) if isinstance(policy, nn.Module) else policy


def is_training(policy: object) -> bool:
    """True for a module of which some part is in training mode, so that dropout may change rollouts."""
    return isinstance(policy, nn.Module) and any(module.training for module in policy.modules())


def is_goal_conditioned(policy: object) -> bool:
    """True if goals have an effect on a policy: the attribute of this name, False where there is none."""
    return bool(getattr(policy, "is_goal_conditioned", False))


# ---- optional: a special imitation objective
# -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ImitationLoss:
    """Loss of imitation and metrics, summed over predictions, the number of which `training.imitation` divides by."""

    loss: Float[Tensor, ""]
    """Sum, differentiable."""
    count: Tensor
    """Number of predictions that count, a scalar."""
    sums: Mapping[str, Tensor] = field(default_factory=dict)
    """Sums of further metrics, scalars, by name in metrics.jsonl. Always the same names."""


@runtime_checkable
class ImitatedPolicy(SavedPolicy, Protocol):
    """A model that brings the objective of pre-training, such as a likelihood of continuous actions.

    Takes the place of `PretrainablePolicy` for a policy without tokens.
    """

    def imitation_loss(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> ImitationLoss:
        """Loss of the logged futures.

        Args:
            scenarios: Scenarios with logged futures, the targets of imitation.
            trained: True = the agent counts; other agents are context.
            update: Number of the update from 0, for schedules. torch's generator was seeded for this update, so a
                resumed run draws the same.
        """
        ...
