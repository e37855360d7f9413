"""The meta-metric as the paper writes it (RLFTSim, equation 1 and its appendix), for study. Not the official one.

It differs on purpose: 20 bins for every feature, raw frequencies instead of smoothed ones (a bin that no rollout visits makes the
feature's score 0), collision, off-road and light as booleans of each step instead of each agent's whole future, and validity
of the log at the step itself. What the paper leaves open is filled in like this: bins span the official ranges, into which
values are clipped; a step without a value (a difference at the end of a rollout) is left out of histogram and product.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.config import BERNOULLI_FEATURES, HISTOGRAM_FEATURES, METRIC_2025, MetricConfig
from rlftsim.realism.features import Features, ScenarioLog
from rlftsim.realism.likelihood import find_bins, histogram_table, stack_histogram_features

PAPER_BINS = 20
_EVENTS = {"collision_indication": "collision", "offroad_indication": "offroad"}


@dataclass(frozen=True, eq=False)
class PaperScore:
    """The paper's formula for one scenario; higher is better."""

    scores: Float[Tensor, "F"]
    """Geometric mean of the logged bins' frequencies, in the order of `FEATURE_NAMES`; NaN where no step counts."""
    meta_metric: Float[Tensor, ""]


def score_by_paper_formula(
    log: ScenarioLog, features: Features, config: MetricConfig = METRIC_2025, *, num_bins: int = PAPER_BINS
) -> PaperScore:
    """Score rollouts by the paper's formula, with ranges and weights of `config`."""
    histograms = {name: replace(getattr(config, name), num_bins=num_bins) for name in HISTOGRAM_FEATURES}
    table = histogram_table(replace(config, **histograms), features.linear_speed.device)
    scores = []
    for side in (_histogram_bins, _event_bins):
        rollouts, has_value = side(features, table)
        logged, counts = side(log.features, table)
        counts = counts & log.agents.future_valid
        scores.append(_geometric_means(rollouts, has_value, logged[:, 0], counts[:, 0], num_bins))
    both = torch.cat(scores)
    weights = torch.tensor(config.weights, device=both.device)
    return PaperScore(both, torch.where(weights > 0, both * weights, 0.0).sum())


def _histogram_bins(features: Features, table) -> tuple[Int64[Tensor, "H N E T"], Bool[Tensor, "H N E T"]]:
    values = stack_histogram_features(features)
    return find_bins(values.flatten(1), table).view(values.shape), ~values.isnan()


def _event_bins(features: Features, table) -> tuple[Int64[Tensor, "J N E T"], Bool[Tensor, "J N E T"]]:
    events = torch.stack([getattr(features, _EVENTS.get(name, name)) for name in BERNOULLI_FEATURES])
    return events.long(), torch.ones_like(events)


def _geometric_means(
    bins: Int64[Tensor, "Q N E T"],
    has_value: Bool[Tensor, "Q N E T"],
    logged: Int64[Tensor, "Q E T"],
    counts: Bool[Tensor, "Q E T"],
    num_bins: int,
) -> Float[Tensor, "Q"]:
    """Per feature: frequencies of the logged bins, multiplied over the (agent, step) pairs that count, to the power 1 / number."""
    by_agent = (bins.transpose(1, 2).flatten(2), has_value.transpose(1, 2).flatten(2).float())  # [Q, E, N T]
    visits = by_agent[1].new_zeros(*by_agent[0].shape[:2], num_bins).scatter_add_(-1, *by_agent)
    frequency = visits / visits.sum(-1, keepdim=True)
    log_frequency = frequency.gather(-1, logged).log()
    return (torch.where(counts, log_frequency, 0.0).sum((-1, -2)) / counts.sum((-1, -2))).exp()
