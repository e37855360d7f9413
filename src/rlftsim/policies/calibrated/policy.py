"""A policy, calibrated: eta · f(state, decision) on its log-probabilities, with named features f.

A model folder has a `calibration.json`: weight and gain of each feature, and the changes on the scenarios held back.

B scenarios, N rollouts, A agents, L decisions, K features.
"""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.goals.types import Goals
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import write_text
from rlftsim.policies.calibrated.actions import ShiftedDistribution, Slopes
from rlftsim.policies.calibrated.candidates import Scene, Traffic, build_scene, join_moments
from rlftsim.policies.calibrated.features import TiltedDistribution, features_by_name
from rlftsim.policies.checkpoint import read_model, save_model
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.policy import ActionPolicy, TokenPolicy, relight
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import STEP_S
from rlftsim.tokens.vocabulary import Vocabulary

Model = TypeVar("Model", bound="CalibratedPolicy")
CHANGES = {
    "rmm": ("RMM", "+.4f"),
    "kinematic": ("kinematic", "+.4f"),
    "interactive": ("interactive", "+.4f"),
    "map_based": ("map-based", "+.4f"),
    "min_ade": ("minADE (m)", "+.3f"),
    "speed": ("speed (m/s)", "+.3f"),
    "evaluated_speed": ("of evaluated agents (m/s)", "+.3f"),
}
"""Heading and format of each change that is shown."""
BASE = "base"
"""Model folder of the policy that is calibrated, inside the folder of the calibrated one."""
CALIBRATION = "calibration.json"
"""How eta was fitted and what each feature earns."""
PASSED_ON = (
    *("fine_tuned_modules", "head_modules", "goal_modules", "is_goal_conditioned", "teacher_forced", "imitation_loss"),
    "sampling",
)
"""Attributes that a calibrated policy passes on from the base, if the base has these."""


def read_calibration(path: Path) -> dict[str, Any]:
    """Values of a calibration.json.

    Raises:
        FileNotFoundError: No such file.
        CheckpointError: Damaged file, or values that are no calibration.
    """
    calibration = read_json(path, "remove it", error=CheckpointError)
    try:
        calibration_table(calibration)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise CheckpointError(f"{path}: no calibration of this version: remove it.") from None
    return calibration


def calibration_table(calibration: Mapping[str, Any]) -> str:
    """Markdown of a calibration.

    Args:
        calibration: Values of calibration.json, as `training.calibrate` writes these.
    """
    num_fitted, num_held_back = calibration["num_scenarios"] or (None, None)
    scenarios, rollouts = _count(num_fitted, "scenario"), _count(calibration["num_rollouts"], "rollout")
    scores = ("rmm", "kinematic", "interactive", "map_based")
    features = [
        [row["feature"], f"{row['eta']:+.3f}", _format_t(row["t"]) or "–", *(f"{row[name]:+.4f}" for name in scores)]
        for row in sorted(calibration["features"], key=lambda row: -row["rmm"])
    ]
    lengths = [
        [f"{row['length']:g}", f"{row['kl']:.4f}", *(_with_t(row[name], style) for name, (_, style) in CHANGES.items())]
        for row in calibration["held_back"]
    ]
    held_back = f"{num_held_back} scenarios that were held back, with t in parentheses"
    if num_held_back == 1:
        held_back = "1 scenario that was held back, too few for a t"
    measured = f"""
Measured on {held_back}. The length taken is
{calibration["length"]:.2f}.

{_markdown(("length", "KL", *(heading for heading, _ in CHANGES.values())), lengths)}
"""
    return f"""## Calibration

What a feature earns in RMM, and of that in which sub-score, is predicted to first order on {scenarios} with
{rollouts} each; t is that of its gradient over scenarios.
Kept as they are, by prediction: {", ".join(calibration["constraints"]) or "nothing"}.

{_markdown(("feature", "eta", "t", "RMM", "kinematic", "interactive", "map-based"), features)}
{measured if lengths else ""}"""


def average_calibrations(
    calibrations: Sequence[Mapping[str, Any]], scale: float, eta: Sequence[float]
) -> dict[str, Any]:
    """Account of the mean of several calibrations: means of the runs, and None for settings in which these differ.

    It is empty where a run has none.

    Args:
        calibrations: Values of calibration.json of runs with the same features.
        scale: Length of the step from the base to the mean.
        eta: Weights of the mean, in the order of the features.
    """
    if not all(calibrations):
        return {}
    table = []
    for weight, rows in zip(eta, zip(*(calibration["features"] for calibration in calibrations))):
        names, ts = rows[0].keys() - {"feature", "eta", "t"}, [row["t"] for row in rows]
        t = None if None in ts else sum(ts) / len(ts)  # a run of a single scenario has none
        scaled = {name: scale * sum(row[name] for row in rows) / len(rows) for name in sorted(names)}
        table.append({"feature": rows[0]["feature"], "eta": weight, "t": t, **scaled})
    first = calibrations[0]
    shared = {name: value if all(c.get(name) == value for c in calibrations) else None for name, value in first.items()}
    constraints = [name for name in first["constraints"] if all(name in c["constraints"] for c in calibrations)]
    # what the runs measured on scenarios held back is not true of the mean
    return {**shared, "constraints": constraints, "length": scale, "features": table, "held_back": []}


def _count(number: int | None, noun: str) -> str:
    return f"{'different numbers of' if number is None else number} {noun}{'' if number == 1 else 's'}"


def _with_t(change: Mapping[str, float | None], style: str) -> str:
    if change["change"] is None:
        return "–"
    t = _format_t(change["t"])
    return f"{change['change']:{style}}" + (f" ({t})" if t else "")


def _format_t(value: float | None) -> str:
    """A t-value; empty for that of a single scenario."""
    return "" if value is None else f"{value:+.1f}"


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["--:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows))


@dataclass(frozen=True, eq=False)
class Context:
    """Context of the base, and the scene that features look at."""

    base: Any
    scene: Scene


@dataclass(frozen=True, eq=False)
class State:
    """State of the base, and the agents' motion."""

    base: Any
    traffic: Traffic

    @property
    def poses(self) -> Tensor | None:
        """Poses of the last decision in the state of the base."""
        return self.base.poses

    @property
    def draws(self) -> Tensor | None:
        """Draws in the state of the base."""
        return self.base.draws

    @property
    def position(self) -> Tensor:
        """Positions [B, N, A, 2] before the decision."""
        return self.traffic.position[..., 0, :]

    @property
    def heading(self) -> Tensor:
        """Headings [B, N, A] before the decision."""
        return self.traffic.heading[..., 0]


class CalibratedPolicy(nn.Module, ABC):
    """A policy with eta · f(state, decision) added to its log-probabilities, whatever its decisions are.

    Log-probabilities, KL and entropy are those of the tilted distribution. Further training changes the weights of the
    base below a fixed eta; imitation of the log without a rollout (`teacher_forced`) sees the base alone.

    Args:
        base: Policy with weights, which is calibrated.
        features: Names of registered features, each at most once.
        eta: Weights of the features; None = zeros, with which the decisions are those of the base, bit for bit.
        calibration: Account of how eta was fitted, stored with the weights; see `training.calibrate`.
    """

    architecture: ClassVar[str]
    base_protocol: ClassVar[type]
    """Protocol that a base has to keep."""
    fingerprint_parts = ("base",)

    def __init__(
        self,
        base: Any,
        features: Sequence[str],
        eta: Sequence[float] | None = None,
        calibration: Mapping[str, Any] | None = None,
    ):
        if not isinstance(base, nn.Module):
            raise ConfigError(f"{type(base).__name__} has no weights: there is nothing to calibrate.")
        if not isinstance(base, self.base_protocol):
            raise ConfigError(
                f"{type(base).__name__} is no {self.base_protocol.__name__}, which a {type(self).__name__} is made of: "
                "add_features finds what fits a policy."
            )
        super().__init__()
        self.base: Any = base
        self.features = tuple(features)
        self._features = features_by_name(self.features)
        count = len(self.features)
        values = torch.zeros(count) if eta is None else torch.tensor(eta, dtype=torch.float32)
        if values.shape != (count,):
            raise ConfigError(f"eta has {len(values)} weights for {count} features: it needs one for each.")
        # A parameter, so that runs can be averaged; never trained by a gradient of the complete model.
        self.eta = nn.Parameter(values, requires_grad=False)
        self._calibration = dict(calibration or {})
        self.train(base.training)

    def __getattr__(self, name: str) -> Any:
        return getattr(super().__getattr__("base"), name) if name in PASSED_ON else super().__getattr__(name)

    # what every `Policy` has; from Python 3.12 on isinstance sees none of the attributes of `__getattr__`

    @property
    def steps_per_decision(self) -> int:
        """Steps of 0.1 s for which the base decides at once."""
        return self.base.steps_per_decision

    @property
    def noise_size(self) -> int:
        """Uniform numbers that a decision of the base takes."""
        return self.base.noise_size

    @property
    def initial_noise_size(self) -> int:
        """Uniform numbers that the base takes at the beginning."""
        return self.base.initial_noise_size

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.base!r}, {len(self.features)} features)"

    @property
    def calibration(self) -> dict[str, Any]:
        """How eta was fitted; empty where that is not known."""
        return self._calibration

    def set_calibration(self, eta: Tensor, calibration: Mapping[str, Any]) -> None:
        """Set fitted weights, and the account of the fit.

        Args:
            eta: Weights [K], in the order of the features.
            calibration: Account of the fit, of values that JSON has, for calibration.json and the card.
        """
        with torch.no_grad():
            self.eta.copy_(eta)
        self._calibration = dict(calibration)

    def requires_grad_(self, requires_grad: bool = True) -> "CalibratedPolicy":
        """Changes the base alone: eta stays fixed."""
        self.base.requires_grad_(requires_grad)
        return self

    # ---- the policy interface -------------------------------------------------------------------------------------

    def encode(self, scenarios: ScenarioBatch) -> Context:
        """Context of the base, lanes and edges of the maps, and the current step."""
        return Context(self.base.encode(scenarios), build_scene(scenarios))

    def relight(self, context: Context, scenarios: ScenarioBatch) -> Context:
        """The context with other traffic lights, which the features do not read.

        Args:
            context: Result of `encode` for the same scenarios.
            scenarios: Scenarios, with the step of the lights.
        """
        return replace(context, base=relight(self.base, context.base, scenarios))

    def begin(self, context: Context, num_rollouts: int, goals: Goals | None, noise: Tensor) -> State:
        """The current step, N times.

        Args:
            context: Result of `encode` for the scenarios.
            num_rollouts: Number N of futures that each scenario gets.
            goals: Goals [B, N, A] of all agents, for the base; None = goal-free.
            noise: Uniform numbers for the base, `initial_noise_size` per agent.
        """
        base = self.base.begin(context.base, num_rollouts, goals, noise)
        return State(base, context.scene.begin(num_rollouts))

    def decide(self, context: Context, state: State) -> Any:
        """Tilted distributions [B, N, A] of the next decision.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision.
        """
        return self._tilt(context.scene, self.base.decide(context.base, state.base), state.traffic)

    def advance(self, context: Context, state: State, decision: Tensor, forced: AgentStates | None = None) -> State:
        """State after a decision.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision, which stays as it is.
            decision: Decisions [B, N, A, *event] that the agents take.
            forced: States [B, N, A, t] imposed from outside, as for the base.
        """
        base = self.base.advance(context.base, state.base, decision, forced)
        return State(base, state.traffic.advance(base.poses, self._seconds))

    def score(self, context: Context, rollouts: Rollouts) -> Any:
        """Tilted distributions [B, N, A, L] along rollouts.

        Args:
            context: Result of `encode` for the scenarios.
            rollouts: Rollouts of the same scenarios, by this policy or another.
        """
        scored: Any = self.base.score(context.base, rollouts)
        if not self.eta.any():
            return scored  # which may not need its logits
        moments = [context.scene.begin(rollouts.num_rollouts)]
        path = torch.cat([rollouts.position, rollouts.heading[..., None]], -1)  # [B, N, A, T, 3]
        for poses in path.split(self.steps_per_decision, 3)[:-1]:
            moments.append(moments[-1].advance(poses, self._seconds))
        return self._tilt(context.scene, scored, join_moments(moments))

    # ---- variants of the base -------------------------------------------------------------------------------------

    def with_goal_conditioning(self, encoding: Any, *, logit_bias: bool | None = None) -> "CalibratedPolicy":
        """Calibrated copy whose base is goal-conditioned, see `ConditionablePolicy`.

        Args:
            encoding: Name of an encoding of goals that the base has.
            logit_bias: Whether a goal-progress bias is added to the logits of the base; None = default of the base.

        Raises:
            ConfigError: The base cannot be conditioned, or not with this encoding.
        """
        if not hasattr(self.base, "with_goal_conditioning"):
            raise ConfigError(f"a {type(self.base).__name__} cannot be goal-conditioned: leave --goal out.")
        return self._with_base(self.base.with_goal_conditioning(encoding, logit_bias=logit_bias))

    def with_guidance(self, scale: float) -> "CalibratedPolicy":
        """Calibrated copy whose base follows goals more closely, see `GoalConditionedPolicy`.

        Args:
            scale: Factor of the goal logit bias of the base, 0 or more; above 1 = more closely than learned.

        Raises:
            ConfigError: The base has no bias that could be scaled.
        """
        if not hasattr(self.base, "with_guidance"):
            raise ConfigError(f"guidance_scale={scale:g} has no effect on a {type(self.base).__name__}: leave it out.")
        return self._with_base(self.base.with_guidance(scale))

    def _with_base(self, base: Any) -> "CalibratedPolicy":
        return type(self)(base, self.features, self.eta.tolist(), self._calibration).to(self.eta.device)

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, eta, calibration.json, README.md and the model folder of the base, `base`.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md, in Markdown; the table of the calibration follows.
        """
        base_card = f"Base of the calibrated model in the folder above.\n\n{card}"
        self.base.save_pretrained(Path(folder) / BASE, card=base_card)
        if self._calibration:
            write_text(Path(folder) / CALIBRATION, json.dumps(self._calibration, indent=1) + "\n")
            card = f"{card}\n{calibration_table(self._calibration)}"
        save_model(folder, self, {"features": self.features}, card=card, weights={"eta": self.eta.detach()})

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Policy of a model folder as written by `save_pretrained`.

        Raises:
            ConfigError: There is no such folder.
            CheckpointError: A file is missing, damaged or does not fit, or a feature is not registered here.
        """
        stored = read_model(folder, architecture=cls.architecture)
        eta = stored.read_weights().get("eta")
        if eta is None or not eta.isfinite().all():
            raise CheckpointError(f"{stored.folder}: no finite eta among the weights: calibrate again.")
        base = load_policy(f"{stored.folder / BASE}{os.sep}")
        path = stored.folder / CALIBRATION
        calibration = read_calibration(path) if path.exists() else {}
        settings = {"base": base, "eta": eta.tolist(), "calibration": calibration, **stored.config}
        return replace(stored, config=settings).build(cls)

    # ---- the tilt -------------------------------------------------------------------------------------------------

    @property
    def _seconds(self) -> float:
        """Duration of a decision."""
        return self.steps_per_decision * STEP_S

    @abstractmethod
    def _tilt(self, scene: Scene, dist: Any, traffic: Traffic) -> Any:
        """The distribution of the base with the features, in a scene with some traffic."""


class CalibratedTokenPolicy(CalibratedPolicy):
    """A `TokenPolicy` with eta · f(state, token) added to the token logits."""

    architecture, base_protocol = "calibrated", TokenPolicy

    @property
    def vocabulary(self) -> Vocabulary:
        """Tokens of the base."""
        return self.base.vocabulary

    def _tilt(self, scene: Scene, dist: Any, traffic: Traffic) -> TiltedDistribution:
        values = (self.eta, self._features, scene, traffic, self.vocabulary, self._seconds)
        return TiltedDistribution(dist, dist.mask, *values, dist.sampling)


class CalibratedActionPolicy(CalibratedPolicy):
    """An `ActionPolicy` with mean actions that eta · f shifts, see `policies.calibrated.actions`."""

    architecture, base_protocol = "calibrated-actions", ActionPolicy

    def predict_pose(self, class_id: Tensor, speed: Tensor, action: Tensor, seconds: float) -> Tensor:
        """Where an action leads, as the base says.

        Args:
            class_id: Classes of the agents.
            speed: Speeds of the agents, m/s.
            action: Actions of the agents.
            seconds: Time from now.
        """
        return self.base.predict_pose(class_id, speed, action, seconds)

    def _tilt(self, scene: Scene, dist: Any, traffic: Traffic) -> ShiftedDistribution:
        slopes = Slopes(dist, self._features, scene, traffic, self.predict_pose, self._seconds)
        return slopes.shift(self.eta)


def add_features(policy: Any, features: Sequence[str]) -> CalibratedPolicy:
    """A policy with features of weight 0; unchanged where a model has the same features already.

    Args:
        policy: Policy whose decisions are tokens, or actions that lead somewhere (`ActionPolicy`).
        features: Names of registered features, each at most once.

    Raises:
        ConfigError: No such policy, no weights, or an unknown feature.
    """
    if isinstance(policy, CalibratedPolicy) and policy.features == tuple(features):
        return policy
    if isinstance(policy, nn.Module) and not isinstance(policy, TokenPolicy | ActionPolicy):
        raise ConfigError(
            f"{type(policy).__name__} has neither a vocabulary nor predict_pose (rollout.policy.ActionPolicy), so no "
            "feature says what a decision leads to: fine-tune it by rlft."
        )
    return (CalibratedTokenPolicy if isinstance(policy, TokenPolicy) else CalibratedActionPolicy)(policy, features)
