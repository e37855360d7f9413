"""Calibration: weights of a few named features of a decision, fitted to a realism reward in a single step.

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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import log
from rlftsim.realism import SUB_SCORES, AgentScores, RealismResult, score_rollouts
from rlftsim.rewards import compute_rewards, leave_one_out, parse_reward
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios, list_scenario_ids
from rlftsim.training.config import CONSTRAINED_MEANS, CalibrateConfig
from rlftsim.training.constraints import MEASURED, check_constraints, constraint_by_name, credit_constraints
from rlftsim.training.data import batch_with_futures
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.parallel import Fabric, all_reduce_sum, num_sharing_memory

RIDGE = 1e-3
"""Part of the Fisher matrix's diagonal that is added to it, so that features that go together share a weight."""

STEPS_PER_KL = 5
"""Steps of 0.1 s that a KL of the settings is about: the duration of a token, whatever that of a decision."""

Vector = Float64[np.ndarray, "K"]


class CalibrateMethod(Method[CalibrateConfig]):
    """Fit the weights of a `CalibratablePolicy`'s features, see `policies.calibrated.policy.add_features`."""

    settings = CalibrateConfig
    title = "calibrate"
    needs_all_updates = True

    def describe(self, settings: CalibrateConfig) -> str:
        """Number of features, and the reward."""
        return f"calibration of {len(settings.features)} features, {settings.reward}"

    def start(
        self, policy: Any, scenarios: Scenarios, settings: CalibrateConfig, fabric: Fabric
    ) -> "CalibrationLearner":
        """Learner of the features' weights; the features have to be those of the settings."""
        check_trainable(policy, scenarios, "calibration", needs=("features", "eta"), is_rewarded=True)
        check_constraints(settings.constraints)
        if tuple(policy.features) != settings.features:
            raise ConfigError(
                f"the policy has the features {', '.join(policy.features)}, the settings others: make it with "
                "add_features(base, config.features)."
            )
        policy.to(fabric.device).eval().requires_grad_(False)
        optimizer = torch.optim.SGD([policy.eta])
        return CalibrationLearner(policy=policy, optimizer=optimizer, config=settings, scenarios=scenarios)

    def update(self, learner: "CalibrationLearner", scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """Measure the next batch of scenarios, chosen by the learner."""
        return learner.measure(fabric)


def split_scenarios(config: CalibrateConfig, scenario_ids: Sequence[str]) -> tuple[list[int], list[int]]:
    """Indices of the scenarios for the direction, and of those held back for the length.

    Windows of a log stay together, all but those of one log at most.

    Args:
        config: Settings of the run: numbers of scenarios, and the seed.
        scenario_ids: Ids of the data set, at least 2; a window has a start behind the log's id, as in "log@100".
    """
    num_fitted, num_held_back = config.split_sizes(len(scenario_ids))
    random = np.random.default_rng(derive_seed(config.seed, "calibrate") % 2**32)
    windows: dict[str, list[int]] = {}
    for index, scenario_id in enumerate(scenario_ids):
        windows.setdefault(scenario_id.split("@")[0], []).append(index)
    logs = list(windows.values())
    selected = [index for log in random.permutation(len(logs)) for index in logs[log]][: num_fitted + num_held_back]
    return selected[num_held_back:], selected[:num_held_back]


def list_scores(config: CalibrateConfig) -> tuple[str, ...]:
    """Names of what is measured of each scenario held back: scores, constrained means, KL and number of decisions."""
    return tuple(dict.fromkeys((*MEASURED, *CONSTRAINED_MEANS, *config.constraints, "kl", "num_decisions")))


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
    """[1 + lengths, scenario held back, score]: as in `names` of the learner."""

    def __init__(self, num_fitted: int, num_held_back: int, config: CalibrateConfig):
        super().__init__()
        width, num_credits = len(config.features), 1 + len(SUB_SCORES) + len(config.constraints)
        num_scores = len(list_scores(config))
        shapes = {"gradients": (num_fitted, num_credits, width), "fisher": (width, width), "counts": (3,)}
        for name, shape in (shapes | {"scores": (1 + len(config.lengths), num_held_back, num_scores)}).items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))


@dataclass(eq=False, kw_only=True)
class CalibrationLearner(Learner):
    """A policy with weights for features, and the statistics that the weights follow from."""

    scenarios: Scenarios

    def __post_init__(self) -> None:
        super().__post_init__()
        self.fitted_ids, self.held_back_ids = split_scenarios(self.config, list(list_scenario_ids(self.scenarios)))
        self.statistics = Statistics(len(self.fitted_ids), len(self.held_back_ids), self.config)
        self.start = self.policy.eta.detach().clone()
        self.names = list_scores(self.config)
        # Batches in order, each a stage and positions in the list of the stage's scenarios. Stage None finds the
        # direction, stage 0 measures without a step, stage i tries length i.
        stages = {
            None: len(self.fitted_ids),
            **dict.fromkeys(range(1 + len(self.config.lengths)), len(self.held_back_ids)),
        }
        self.tasks = [
            (stage, list(range(count))[first : first + self.config.batch_size])
            for stage, count in stages.items()
            for first in range(0, count, self.config.batch_size)
        ]

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
            note = f"direction, RMM {values['rmm']:.3f}"
        else:
            values = self._try_length(stage, positions, batches, fabric)
            note = f"length {values['length']:g}, RMM {values['rmm']:.3f}, KL {values['kl']:.4f}"
        self.finish_update(is_good=True)
        return UpdateReport(values, note)

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
        mean, num_tokens = (
            self.statistics.gradients.numpy().mean(0),
            self._count_tokens(float(self.statistics.counts[0])),
        )
        fixed = mean[1 + len(SUB_SCORES) :]
        return natural_direction(mean[0], self.statistics.fisher.numpy() / max(num_tokens, 1.0), fixed, self.config.kl)

    def fit(self) -> tuple[Float64[np.ndarray, "K"], dict[str, Any]]:
        """The weights, and a record of the fit: values that JSON has."""
        scores = {name: self.statistics.scores[..., index].numpy() for index, name in enumerate(self.names)}
        kls = scores["kl"].sum(1) / self._count_tokens(scores["num_decisions"].sum(1)).clip(1)  # [1 + X]
        gains = scores["rmm"][1:] - scores["rmm"][0]  # [X, S]
        scored = gains.T[np.isfinite(gains).all(0)]
        length = best_length(self.config.lengths, scored) if len(scored) else 0.0
        # KL grows with the square of the length: cut where the measured ones say so
        per_length = max(kl / tried**2 for kl, tried in zip(kls[1:], self.config.lengths))
        length = min(length, math.sqrt(self.config.max_kl / per_length)) if per_length > 0 else length
        step = length * self.direction
        eta = self.start.double().cpu().numpy() + step
        gradients = self.statistics.gradients.numpy()
        table = [
            {"feature": name, "eta": float(eta[k]), "t": t_value(gradients[:, 0, k])}
            | {score: float(step[k] * gradients[:, row, k].mean()) for row, score in enumerate(("rmm", *SUB_SCORES))}
            for k, name in enumerate(self.config.features)
        ]
        changes = []
        for row, (tried, kl) in enumerate(zip(self.config.lengths, kls[1:]), 1):
            changes.append({"length": tried, "kl": float(kl)})
            for name in self.names[:-2]:
                change = scores[name][row] - scores[name][0]
                changes[-1][name] = {"change": finite_mean(change), "t": t_value(change[np.isfinite(change)])}
        return eta, {
            "reward": self.config.reward,
            "constraints": list(self.config.constraints),
            "num_scenarios": [len(self.fitted_ids), len(self.held_back_ids)],
            "num_rollouts": self.config.num_rollouts,
            "length": length,
            "base": {name: finite_mean(scores[name][0]) for name in self.names[:-2]},
            "features": table,
            "held_back": changes,
        }

    def _count_tokens(self, num_decisions: Any) -> Any:
        """Number of tokens that last as long as some decisions."""
        return num_decisions * (self.policy.steps_per_decision / STEPS_PER_KL)

    # ---- what is measured -------------------------------------------------------------------------------------------

    def _find_gradients(self, positions: list[int], batches: list[list[int]], fabric: Fabric) -> dict[str, float]:
        """Gradients and Fisher matrix of some scenarios, into the statistics."""
        statistics, device = self.statistics, fabric.device
        measured, counts = [], torch.zeros(3, dtype=torch.float64, device=device)
        for batch_positions in batches:
            batch, rollouts, recorder, realism, agents = self._roll_out(batch_positions, None, fabric)
            credits = self._assign_credits(batch, rollouts, realism, agents)  # [credit, B, N, A]
            earned = credits[0][batch.evaluated_mask[:, None].expand_as(credits[0])]
            num_earning = torch.tensor(float(len(earned))).to(device)
            counts += torch.stack([rollouts.decision_mask.sum().double(), num_earning, earned.square().sum()])
            measured.append((batch_positions, recorder.score.double(), credits, realism.meta_metric.double()))
        statistics.counts += all_reduce_sum(counts, fabric).cpu()
        limit = self.config.clip * math.sqrt(float(statistics.counts[2] / statistics.counts[1].clamp(min=1)))
        rows = torch.zeros(len(positions), *statistics.gradients.shape[1:], dtype=torch.float64, device=device)
        fisher = torch.zeros_like(statistics.fisher, device=device)
        rmm_sums = torch.zeros(2, dtype=torch.float64, device=device)
        for batch_positions, score, credits, rmm in measured:
            credits = torch.cat([credits[:1].clamp(-limit, limit), credits[1:]])
            gradients = torch.einsum("cbna,bnak->bck", credits, score)
            rows[[positions.index(position) for position in batch_positions]] = gradients
            flat = score.flatten(0, 2)
            fisher += flat.T @ flat
            rmm_sums += torch.stack([rmm.nansum(), rmm.isfinite().sum()])
        statistics.gradients[positions] = all_reduce_sum(rows, fabric).cpu()
        statistics.fisher += all_reduce_sum(fisher, fabric).cpu()
        total, count = all_reduce_sum(rmm_sums, fabric).tolist()
        return {"rmm": total / max(count, 1.0), "credit_std": limit / self.config.clip}

    def _assign_credits(
        self, batch: ScenarioBatch, rollouts: Rollouts, realism: RealismResult, agents: AgentScores
    ) -> Float64[Tensor, "C B N A"]:
        """Credits of the agents for the reward, the three sub-scores and the constraints."""
        rewards = compute_rewards(parse_reward(self.config.reward), realism, rollouts, batch, agents, credit_mixing=0.0)
        shares = [rewards.by_agent.double(), *(agents.sub_scores[name].double() for name in SUB_SCORES)]
        # A leave-one-out reward is centered on all rollouts: on the others it is larger by N / (N - 1). Then the score
        # function of a rollout times its credit is the gradient to first order, though the mean depends on the rollout.
        credits = [leave_one_out(values) for values in shares]
        decides = rollouts.decision_mask.any(-1)  # [B, N, A]
        earned = torch.stack([torch.where(decides, values.nan_to_num(), 0.0) for values in credits])
        return torch.cat([earned, credit_constraints(self.config.constraints, batch, rollouts, agents)])

    def _try_length(
        self, stage: int, positions: list[int], batches: list[list[int]], fabric: Fabric
    ) -> dict[str, float]:
        """Scores of some of the scenarios held back with a length of the step, into the statistics."""
        length = (0.0, *self.config.lengths)[stage]
        with torch.no_grad():
            self.policy.eta.copy_(self.start + torch.from_numpy(length * self.direction).to(self.start))
        rows = torch.zeros(len(positions), len(self.names), dtype=torch.float64, device=fabric.device)
        for batch_positions in batches:
            batch, rollouts, recorder, realism, agents = self._roll_out(batch_positions, stage, fabric)
            values = {name: getattr(realism, "meta_metric" if name == "rmm" else name) for name in MEASURED}
            rules = {name: constraint_by_name(name) for name in self.names[:-2] if name not in MEASURED}
            values |= {name: rule.measure(realism, batch, rollouts, agents) for name, rule in rules.items()}
            values |= {"kl": recorder.kl, "num_decisions": rollouts.decision_mask.flatten(1).sum(1)}
            rows[[positions.index(position) for position in batch_positions]] = torch.stack(
                [values[name].double() for name in self.names], -1
            )
        rows = all_reduce_sum(rows, fabric).cpu()
        self.statistics.scores[stage, positions] = rows
        means = dict(zip(self.names, rows.nanmean(0).tolist()))
        kl = means.pop("kl") / max(self._count_tokens(means.pop("num_decisions")), 1.0)
        return {"length": length, **means, "kl": kl}

    def _roll_out(
        self, positions: list[int], stage: int | None, fabric: Fabric
    ) -> tuple[ScenarioBatch, Rollouts, "Recorder", RealismResult, AgentScores]:
        """Scenarios of a stage, their rollouts with what was recorded, and the scores of these."""
        ids, purpose = (self.fitted_ids, "direction") if stage is None else (self.held_back_ids, "length")
        batch = batch_with_futures(self.scenarios, [ids[position] for position in positions]).to(fabric.device)
        recorder = Recorder(start=None if stage is None else self.start)
        with fabric.autocast():
            rollouts = simulate(
                self.policy, batch, num_rollouts=self.config.num_rollouts,
                seed=derive_seed(self.config.seed, "calibrate", purpose), choose=recorder,
            )  # fmt: skip
        return batch, rollouts, recorder, *score_rollouts(batch, rollouts, self.config.metric)


class Recorder:
    """A `choose` of `simulate` that adds up the score function of the weights, or the KL to the start of the run.

    Args:
        start: Weights [K] of the model that the KL is measured to; None = the score function.
    """

    score: Any = 0.0
    """[B, N, A, K], summed over the decisions of each agent."""
    kl: Any = 0.0
    """[B], summed over decisions, nats."""

    def __init__(self, *, start: Tensor | None):
        self.start = start

    def __call__(self, distribution: Any, state: object, sampling: Any, noise: Tensor) -> Tensor:
        """Decisions [B, N, A, *event], drawn as without a recorder.

        Args:
            distribution: Distribution of a calibrated policy.
            state: State before the decision; not read here.
            sampling: Temperature and truncation of the draw.
            noise: Uniform numbers of the draw.
        """
        decision = distribution.sample(sampling, noise)
        if self.start is None:
            self.score = self.score + distribution.score_function(decision)
        else:
            self.kl = self.kl + distribution.kl(distribution.with_eta(self.start)).flatten(1).sum(1)
        return decision


# ---- the step --------------------------------------------------------------------------------------------------------


def natural_direction(
    gradient: Vector, fisher: Float64[np.ndarray, "K K"], fixed: Float64[np.ndarray, "C K"], kl: float
) -> Vector:
    """Direction of the largest gain per KL, among directions with a predicted change of 0 in the fixed means.

    Args:
        gradient: Gradient [K] of the objective by the weights.
        fisher: Covariance of the score function, per decision. A weight without covariance stays 0.
        fixed: Gradients of means that are to stay unchanged.
        kl: Predicted KL of the result, ½ e·F e, nats per decision.

    Returns:
        The step of that KL; zeros where the gradient has no part that is free to be followed.
    """
    is_used = np.diag(fisher) > 0
    step = np.zeros_like(gradient)
    metric = fisher[np.ix_(is_used, is_used)]
    metric = metric + RIDGE * np.diag(np.diag(metric))
    free = np.linalg.solve(metric, gradient[is_used]) if is_used.any() else step[is_used]
    constrained = fixed[:, is_used]
    if constrained.any():
        # in the metric of the KL, so that the step changes as little as it has to
        across = np.linalg.solve(metric, constrained.T)  # [K, C]
        free = free - across @ np.linalg.lstsq(constrained @ across, constrained @ free, rcond=1e-10)[0]
    square = free @ metric @ free
    # what projection leaves of a gradient that lies along the constraints is rounding
    if square > 1e-20 * max(gradient @ gradient, 1e-300):
        step[is_used] = free * np.sqrt(2 * kl / square)
    return step


def best_length(lengths: Sequence[float], gains: Float64[np.ndarray, "S X"]) -> float:
    """Length with the greatest gain on the parabola through 0 that fits measured gains best, up to the longest length.

    Args:
        lengths: Lengths that were tried, above 0.
        gains: Measured gain of each length in each scenario.
    """
    tried, mean = np.asarray(lengths), gains.mean(0)
    powers = np.stack([tried, tried**2], 1)[:, : len(tried)]  # a single length has a slope alone
    slope, bend = (*np.linalg.lstsq(powers, mean, rcond=None)[0], 0.0)[:2]
    if bend < 0:
        return float(np.clip(-slope / (2 * bend), 0.0, tried.max()))
    return float(tried.max()) if slope * tried.max() + bend * tried.max() ** 2 > 0 else 0.0


def finite_mean(values: Float64[np.ndarray, "S"]) -> float | None:
    """Mean of the finite values; None without any, such as of a score that no scenario held back has."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def t_value(values: Float64[np.ndarray, "S"]) -> float | None:
    """Mean of some scenarios over its standard error; 0 where all are equal, None for a single scenario."""
    if len(values) < 2:
        return None
    spread = values.std(ddof=1)
    return float(values.mean() / (spread / np.sqrt(len(values)))) if spread > 0 else 0.0
