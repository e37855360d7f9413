"""Calibration: weights of a few named features on the token logits, fitted to a realism reward in a single step.

    eta = length * natural direction(gradient of the reward, Fisher matrix, gradients of constrained means)

1. Rollouts of most of the training scenarios. The score function of the weights, summed over an agent's decisions,
   times the agent's reward is an estimate of the reward's gradient; the covariance is the Fisher matrix. There is no
   backward pass through the network, no optimizer and no learning rate.
2. The direction of the largest predicted gain per KL among the directions that leave the constrained means unchanged.
3. The length: rollouts of the scenarios that were held back, with the same noise for each length that is tried.

A few weights need few rollouts: the signal of ten features is as large as the noise after some hundreds of rollouts,
the signal of all weights of a network is not after tens of thousands. K features, C constraints, N rollouts, A agents.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from rlftsim.errors import ConfigError, check_positive, check_types
from rlftsim.jobs.progress import log
from rlftsim.realism import AgentScores, RealismResult, compute_batch_features, metric_by_name, score_batch_features
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rewards import compute_rewards, parse_reward, write_reward
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.constraints import CONSTRAINTS, subtract_baseline
from rlftsim.training.data import batch_with_futures
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.natural_step import best_length, natural_direction, t_value
from rlftsim.training.parallel import DeviceConfig, Fabric, all_reduce_sum, num_sharing_memory

SUB_SCORES = ("kinematic", "interactive", "map_based")
MEASURED = ("rmm", *SUB_SCORES, "collision_rate", "offroad_rate")
"""Scores of the held-back scenarios, as `RealismResult` has them."""
FEATURES = (
    *("speed_gap_under_2s", "speed_gap_2_to_4s", "turn_to_lane_direction", "turn_to_lane_center"),
    *("temperature_slow", "temperature_middle", "temperature_fast", "speed_slow", "speed_middle", "speed_fast"),
    *("overlap_0.5s", "overlap_1s", "edge_0.5s", "edge_1s"),
    *("overlap_0.5s_walking_cycling", "overlap_1s_walking_cycling", "edge_0.5s_walking_cycling"),
)
"""Features of this package, see `policies.calibrated.features`."""


@dataclass(frozen=True)
class CalibrateConfig:
    """Calibration of a model with a vocabulary: a few named features on the token logits."""

    features: tuple[str, ...] = FEATURES
    """Names of the features; `rlftsim.features` is their entry-point group."""
    reward: str = "mloo"
    """A registered reward, or a sum such as "mloo + 0.1*collision_offroad", credited to agents."""
    metric: str = "2025"
    """Configuration of the meta-metric the reward is made of."""
    constraints: tuple[str, ...] = ("speed", "evaluated_speed")
    """Means that the step leaves as they are, by prediction: speed, evaluated_speed, min_ade."""
    kl: float = 0.01
    """Predicted KL of a step of length 1, nats per decision."""
    lengths: tuple[float, ...] = (0.7, 1.4)
    """Lengths that are tried on the scenarios held back; the best one on a parabola through their gains is taken."""
    max_kl: float = 0.03
    """Largest measured KL of the result, nats per decision; a longer step is cut."""
    held_back: float = 0.2
    """Fraction of the scenarios that chooses the length, and not the direction."""
    num_scenarios: int = 256
    """Training scenarios that are used at most, drawn with the seed."""
    num_rollouts: int = 8
    """Rollouts N of each scenario and length."""
    clip: float = 3.0
    """Rewards of agents are clipped to so many standard deviations of all until then."""
    batch_size: int = 4
    """Scenarios between two lines of metrics, over all processes."""
    micro_batch_size: int = 2
    """Scenarios in memory at once, on each GPU or in all processes on a CPU together."""
    checkpoint_every: int = 4
    """Batches between two checkpoints, from which a run that was stopped goes on."""
    seed: int = 0
    """Seed of everything that is random in the run."""
    device: DeviceConfig = field(default_factory=DeviceConfig)

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(
            self, ("kl", "max_kl", "clip", "num_scenarios", "batch_size", "micro_batch_size", "checkpoint_every")
        )
        if self.num_rollouts < 2:
            raise ConfigError(f"credit needs at least 2 rollouts, got {self.num_rollouts}: raise num_rollouts.")
        if not 0 < self.held_back < 1:
            raise ConfigError(f"held_back is a fraction between 0 and 1, got {self.held_back}.")
        if not self.lengths or min(self.lengths) <= 0:
            raise ConfigError(f"lengths are numbers above 0, at least one, got {self.lengths}.")
        unexpected = [name for name in self.constraints if name not in CONSTRAINTS]
        if unexpected:
            raise ConfigError(f"no constraint {unexpected[0]!r}: there are {', '.join(CONSTRAINTS)}.")
        metric_by_name(self.metric)
        object.__setattr__(self, "reward", write_reward(parse_reward(self.reward)))

    @property
    def warmup_updates(self) -> int:
        """0: there is no learning rate."""
        return 0

    @property
    def max_skipped_in_a_row(self) -> int:
        """1: no batch is skipped."""
        return 1

    def split(self, num_scenarios: int) -> tuple[list[int], list[int]]:
        """Scenarios for the direction, and scenarios held back for the length.

        Args:
            num_scenarios: Number of scenarios in the data set, at least 2.

        Raises:
            ConfigError: Fewer than two scenarios.
        """
        if num_scenarios < 2:
            raise ConfigError("calibration needs at least 2 scenarios: one for the direction and one for its length.")
        key = derive_seed(self.seed, "calibrate") % 2**32
        selected = np.random.default_rng(key).permutation(num_scenarios)[: self.num_scenarios].tolist()
        num_held_back = min(max(round(self.held_back * len(selected)), 1), len(selected) - 1)
        return selected[num_held_back:], selected[:num_held_back]

    def tasks(self, num_scenarios: int) -> list[tuple[int | None, list[int]]]:
        """Batches of the run in order, each a stage and positions in the list of the stage's scenarios.

        Stage None finds the direction, stage 0 measures without a step, stage i tries length i.

        Args:
            num_scenarios: Number of scenarios in the data set, at least 2.
        """
        fitted_ids, held_back_ids = self.split(num_scenarios)
        stages: list[tuple[int | None, int]] = [(None, len(fitted_ids))]
        stages += [(index, len(held_back_ids)) for index in range(len(self.lengths) + 1)]
        return [
            (stage, list(range(first, min(first + self.batch_size, count))))
            for stage, count in stages
            for first in range(0, count, self.batch_size)
        ]

    def num_updates(self, num_scenarios: int) -> int:
        """Batches of the run."""
        return len(self.tasks(num_scenarios))


class CalibrateMethod(Method[CalibrateConfig]):
    """Fit the weights of a `CalibratablePolicy`'s features, such as `policies.calibrated.policy.CalibratedPolicy`."""

    settings = CalibrateConfig
    title = "calibrate"

    def describe(self, settings: CalibrateConfig) -> str:
        """Number of features, and the reward."""
        return f"calibration of {len(settings.features)} features, {settings.reward}"

    def start(
        self, policy: Any, scenarios: Scenarios, settings: CalibrateConfig, fabric: Fabric
    ) -> "CalibrationLearner":
        """Learner of the features' weights; the features have to be those of the settings."""
        check_trainable(policy, scenarios, "calibration", needs=("vocabulary", "features", "eta"), is_rewarded=True)
        if tuple(policy.features) != settings.features:
            raise ConfigError(
                f"the policy has the features {', '.join(policy.features)}, the settings others: make it with "
                "CalibratedPolicy(base, config.features)."
            )
        policy.to(fabric.device).eval().requires_grad_(False)
        optimizer = torch.optim.SGD([policy.eta])
        return CalibrationLearner(policy=policy, optimizer=optimizer, config=settings, scenarios=scenarios)

    def update(self, learner: "CalibrationLearner", scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """Measure the next batch of scenarios, chosen by the learner."""
        return learner.measure(fabric)


class Statistics(nn.Module):
    """Measurements of each scenario so far: all that a run resumes from.

    Args:
        num_fitted: Scenarios for the direction.
        num_held: Scenarios held back.
        config: Settings of the run.
    """

    gradients: Tensor
    """[scenario, credit, K]: of the reward, the three sub-scores and the constraints."""
    fisher: Tensor
    """[K, K]: sum over decisions."""
    counts: Tensor
    """[3]: decisions, agents with a credit, and the sum of their squared credits."""
    scores: Tensor
    """[1 + lengths, scenario held back, score]: as in `SCORES` of the learner."""

    def __init__(self, num_fitted: int, num_held_back: int, config: CalibrateConfig):
        super().__init__()
        width, num_credits = len(config.features), 1 + len(SUB_SCORES) + len(config.constraints)
        self.register_buffer("gradients", torch.zeros(num_fitted, num_credits, width, dtype=torch.float64))
        self.register_buffer("fisher", torch.zeros(width, width, dtype=torch.float64))
        self.register_buffer("counts", torch.zeros(3, dtype=torch.float64))
        shape = 1 + len(config.lengths), num_held_back, len(MEASURED) + len(CONSTRAINTS) + 2
        self.register_buffer("scores", torch.zeros(shape, dtype=torch.float64))


@dataclass(eq=False, kw_only=True)
class CalibrationLearner(Learner):
    """A policy with weights for features, and the statistics that the weights follow from."""

    scenarios: Scenarios

    def __post_init__(self) -> None:
        self.fitted_ids, self.held_back_ids = self.config.split(len(self.scenarios))
        self.tasks = self.config.tasks(len(self.scenarios))
        self.statistics = Statistics(len(self.fitted_ids), len(self.held_back_ids), self.config)
        self.start = self.policy.eta.detach().clone()
        self.names = (*MEASURED, *CONSTRAINTS, "kl", "num_decisions")

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The weights of the features."""
        return [self.policy.eta]

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The statistics: a checkpoint needs no other modules."""
        return {"statistics": self.statistics}

    def measure(self, fabric: Fabric) -> UpdateReport:
        """Measure the next batch of scenarios.

        Args:
            fabric: Processes, each of which measures a part of the batch.
        """
        stage, positions = self.tasks[self.update]
        # Row by row and added to zeros, so that no number depends on the processes.
        process_positions = positions[fabric.global_rank :: fabric.world_size]
        size = max(self.config.micro_batch_size // num_sharing_memory(fabric), 1)
        batches = [process_positions[first : first + size] for first in range(0, len(process_positions), size)]
        if stage is None:
            values = self._find_gradients(positions, batches, fabric)
        else:
            values = self._try_length(stage, positions, batches, fabric)
        self.finish_update(is_good=True)
        return UpdateReport(values, self._note(stage, values))

    def finish(self) -> None:
        """Choose the length and hand the weights to the policy."""
        eta, calibration = self.fit()
        self.policy.set_calibration(torch.from_numpy(eta).to(self.policy.eta), calibration)
        if not eta.any():
            log.warning("no length of the step gained realism on the scenarios held back: all weights are 0.")

    # ---- the fit --------------------------------------------------------------------------------------------------

    @cached_property
    def direction(self) -> Float64[np.ndarray, "K"]:
        """The step of length 1; to be asked for once all gradients are there."""
        mean, decisions = self.statistics.gradients.numpy().mean(0), float(self.statistics.counts[0])
        fixed = mean[1 + len(SUB_SCORES) :]
        return natural_direction(mean[0], self.statistics.fisher.numpy() / max(decisions, 1.0), fixed, self.config.kl)

    def fit(self) -> tuple[Float64[np.ndarray, "K"], dict[str, Any]]:
        """The weights, and a record of the fit: values that JSON has."""
        scores = {name: self.statistics.scores[..., index].numpy() for index, name in enumerate(self.names)}
        kls = scores["kl"].sum(1) / scores["num_decisions"].sum(1).clip(1)  # [1 + X]
        gains = scores["rmm"][1:] - scores["rmm"][0]  # [X, S]
        length = best_length(self.config.lengths, gains.T[np.isfinite(gains).all(0)])
        # KL grows with the square of the length: cut where the measured ones say so
        per_length = max((kl - kls[0]) / tried**2 for kl, tried in zip(kls[1:], self.config.lengths))
        length = min(length, math.sqrt(self.config.max_kl / per_length)) if per_length > 0 else length
        step = length * self.direction
        eta = self.start.double().cpu().numpy() + step
        gradients = self.statistics.gradients.numpy()
        table = [
            {
                "feature": name,
                "eta": float(eta[index]),
                "t": t_value(gradients[:, 0, index]),
                "rmm": float(step[index] * gradients[:, 0, index].mean()),
                **{
                    score: float(step[index] * gradients[:, 1 + position, index].mean())
                    for position, score in enumerate(SUB_SCORES)
                },
            }
            for index, name in enumerate(self.config.features)
        ]
        changes = [
            {
                "length": tried,
                "kl": float(kl - kls[0]),
                **{
                    name: {"change": float(np.nanmean(scores[name][row] - scores[name][0])),
                           "t": t_value(_finite(scores[name][row] - scores[name][0]))}
                    for name in self.names[:-2]
                },
            }
            for row, (tried, kl) in enumerate(zip(self.config.lengths, kls[1:]), 1)
        ]  # fmt: skip
        return eta, {
            "reward": self.config.reward,
            "constraints": list(self.config.constraints),
            "num_scenarios": [len(self.fitted_ids), len(self.held_back_ids)],
            "num_rollouts": self.config.num_rollouts,
            "length": length,
            "base": {name: float(np.nanmean(scores[name][0])) for name in self.names[:-2]},
            "features": table,
            "held_back": changes,
        }

    # ---- what is measured -------------------------------------------------------------------------------------------

    def _find_gradients(self, positions: list[int], batches: list[list[int]], fabric: Fabric) -> dict[str, float]:
        """Gradients and Fisher matrix of some scenarios, into the statistics."""
        statistics, device = self.statistics, fabric.device
        measured = [(batch_positions, *self._measure_credits(batch_positions, fabric)) for batch_positions in batches]
        counts = torch.zeros(3, dtype=torch.float64, device=device)
        for _, batch, _, credits, decisions, _ in measured:
            earned = credits[0][batch.evaluated_mask[:, None].expand_as(credits[0])]
            counts += torch.stack(
                [decisions.sum().double(), torch.tensor(float(len(earned))).to(device), earned.square().sum()]
            )
        statistics.counts += all_reduce_sum(counts, fabric).cpu()
        limit = self.config.clip * math.sqrt(float(statistics.counts[2] / statistics.counts[1].clamp(min=1)))
        rows = torch.zeros(len(positions), *statistics.gradients.shape[1:], dtype=torch.float64, device=device)
        fisher = torch.zeros_like(statistics.fisher, device=device)
        rmm = torch.zeros(2, dtype=torch.float64, device=device)
        for batch_positions, _, score, credits, _, realism in measured:
            credits = torch.cat([credits[:1].clamp(-limit, limit), credits[1:]])  # [credit, B, N, A]
            gradients = torch.einsum("cbna,bnak->bck", credits, score)
            rows[[positions.index(position) for position in batch_positions]] = gradients
            flat = score.flatten(0, 2)
            fisher += flat.T @ flat
            rmm += torch.stack([realism.meta_metric.double().nansum(), realism.meta_metric.isfinite().sum()])
        statistics.gradients[positions] = all_reduce_sum(rows, fabric).cpu()
        statistics.fisher += all_reduce_sum(fisher, fabric).cpu()
        total, count = all_reduce_sum(rmm, fabric).tolist()
        return {"rmm": total / max(count, 1.0), "credit_std": limit / self.config.clip}

    def _measure_credits(
        self, batch_positions: list[int], fabric: Fabric
    ) -> tuple[ScenarioBatch, Tensor, Tensor, Tensor, RealismResult]:
        """Batch, score function [B, N, A, K], credits [credit, B, N, A], decisions [B], realism."""
        batch = self._load(batch_positions, self.fitted_ids, fabric)
        rollouts, recorder = self._simulate(batch, "direction", fabric)
        realism, agents = self._score(batch, rollouts)
        rewards = compute_rewards(parse_reward(self.config.reward), realism, rollouts, batch, agents, credit_mixing=0.0)
        decides = rollouts.decision_mask.any(-1)  # [B, N, A]
        shares = [rewards.by_agent.double(), *(agents.sub_scores[name].double() for name in SUB_SCORES)]
        # A leave-one-out reward is centered on all rollouts: on the others it is larger by N / (N - 1).
        credits = [subtract_baseline(values) for values in shares]
        for name in self.config.constraints:
            constraint = CONSTRAINTS[name]
            credits.append(constraint.credit(constraint.shares(batch, rollouts, agents).double()))
        stacked = torch.stack([torch.where(decides, values.nan_to_num(), 0.0) for values in credits])
        return batch, recorder.score.double(), stacked, rollouts.decision_mask.flatten(1).sum(1), realism

    def _try_length(
        self, stage: int, positions: list[int], batches: list[list[int]], fabric: Fabric
    ) -> dict[str, float]:
        """Scores of some of the scenarios held back with a length of the step, into the statistics."""
        length = (0.0, *self.config.lengths)[stage]
        with torch.no_grad():
            self.policy.eta.copy_(self.start + torch.from_numpy(length * self.direction).to(self.start))
        rows = torch.zeros(len(positions), len(self.names), dtype=torch.float64, device=fabric.device)
        for batch_positions in batches:
            batch = self._load(batch_positions, self.held_back_ids, fabric)
            rollouts, recorder = self._simulate(batch, "length", fabric)
            realism, agents = self._score(batch, rollouts)
            values = {name: getattr(realism, "meta_metric" if name == "rmm" else name) for name in MEASURED}
            values |= {name: rule.value(rule.shares(batch, rollouts, agents)) for name, rule in CONSTRAINTS.items()}
            values |= {"kl": recorder.kl, "num_decisions": rollouts.decision_mask.flatten(1).sum(1)}
            rows[[positions.index(position) for position in batch_positions]] = torch.stack(
                [values[n].double() for n in self.names], -1
            )
        rows = all_reduce_sum(rows, fabric).cpu()
        self.statistics.scores[stage, positions] = rows
        means = dict(zip(self.names, rows.nanmean(0).tolist()))
        kl = means.pop("kl") / max(means.pop("num_decisions"), 1.0)
        return {"length": length, **means, "kl": kl}

    def _load(self, positions: list[int], ids: list[int], fabric: Fabric) -> ScenarioBatch:
        return batch_with_futures(self.scenarios, [ids[position] for position in positions]).to(fabric.device)

    def _simulate(self, batch: ScenarioBatch, purpose: str, fabric: Fabric) -> tuple[Rollouts, "_Recorder"]:
        recorder = _Recorder(needs_score=purpose == "direction")
        with fabric.autocast():
            rollouts = simulate(
                self.policy, batch, num_rollouts=self.config.num_rollouts,
                seed=derive_seed(self.config.seed, "calibrate", purpose), choose=recorder,
            )  # fmt: skip
        return rollouts, recorder

    def _score(self, batch: ScenarioBatch, rollouts: Rollouts) -> tuple[RealismResult, AgentScores]:
        metric = metric_by_name(self.config.metric)
        features = compute_batch_features(batch.scenarios, states_of_rollouts(batch, rollouts), missing_map="neutral")
        return score_batch_features(features, metric), AgentScores(features, metric, batch.agent_mask.shape[1])

    def _note(self, stage: int | None, values: Mapping[str, float]) -> str:
        if stage is None:
            return f"direction, RMM {values['rmm']:.3f}"
        return f"length {values['length']:g}, RMM {values['rmm']:.3f}, KL {values['kl']:.4f}"


class _Recorder:
    """A `choose` of `simulate` that adds up the score function of the weights, or the KL to the base.

    Args:
        needs_score: True = the score function, False = the KL.
    """

    score: Any = 0.0
    """[B, N, A, K], summed over the decisions of each agent."""
    kl: Any = 0.0
    """[B], summed over decisions, nats."""

    def __init__(self, *, needs_score: bool):
        self.needs_score = needs_score

    def __call__(self, distribution: Any, state: object, sampling: Sampling, noise: Tensor) -> Tensor:
        decision = distribution.sample(sampling, noise)
        if self.needs_score:
            self.score = self.score + distribution.score_function(decision)
        else:
            self.kl = self.kl + distribution.kl(distribution.base).flatten(1).sum(1)
        return decision


def _finite(values: Float64[np.ndarray, "S"]) -> Float64[np.ndarray, "n"]:
    return values[np.isfinite(values)]
