"""An explanation as one page of HTML that needs no network: what was lost, where, and the histograms behind it."""

from html import escape

import numpy as np
from jaxtyping import Float

from rlftsim.experiments.explanation import WHOLE_FUTURE, Explanation, FeatureHistogram
from rlftsim.realism.config import BERNOULLI_FEATURES, FEATURE_NAMES, HISTOGRAM_FEATURES
from rlftsim.scenario.types import STEP_S
from rlftsim.viewer.chart import Chart, Curve, chart_html
from rlftsim.viewer.page import Animation, Panel, animation_html, page_html
from rlftsim.viewer.scene import build_scene, logged_trajectories

MAX_STRIPS = 10
"""Rows of (feature, agent) drawn over time."""
MAX_SHOWN_ROLLOUTS = 8
_UNITS = {
    "linear_speed": "m/s",
    "linear_acceleration": "m/s²",
    "angular_speed": "rad/s",
    "angular_acceleration": "rad/s²",
    "distance_to_nearest_object": "m",
    "time_to_collision": "s",
    "distance_to_road_edge": "m",
}
_BAR_WIDTH, _BAR_HEIGHT, _LEFT, _BOTTOM, _TOP = 380, 190, 40, 46, 8
_CSS = """
.results thead th.narrow { white-space: normal; min-width: 64px; padding-left: 8px; padding-right: 8px; }
.cost { background: color-mix(in srgb, var(--bad) calc(var(--heat) * 70%), transparent); }
.gain { background: color-mix(in srgb, var(--good) calc(var(--heat) * 70%), transparent); }
.strip { display: grid; grid-template-columns: minmax(200px, 290px) minmax(0, 1fr) 70px; gap: 4px 14px; align-items: center; font-size: 14px; padding: 14px 18px; font-variant-numeric: tabular-nums; }
.strip svg { width: 100%; height: 20px; display: block; border-radius: 4px; background: var(--page); }
.strip .amount { text-align: right; }
.strip .clock { display: flex; justify-content: space-between; color: var(--muted); font-size: 12px; min-width: 0; }
.swatch { width: 12px; height: 12px; border-radius: 3px; }
"""


def explanation_html(explanation: Explanation) -> str:
    """The whole page."""
    name = explanation.scenario.scenario_id
    parts = [
        f"<h1>Scenario {escape(name)}</h1>",
        f'<p class="lead">{_lead(explanation)}</p>',
        _tiles_html(explanation),
        "<h2>Which feature</h2>",
        _features_html(explanation),
        "<h2>Which agent</h2>",
        _agents_html(explanation),
        "<h2>Which steps</h2>",
        _strips_html(explanation),
        f'<div class="charts">{chart_html(_cost_chart(explanation))}{chart_html(_event_chart(explanation))}</div>',
        "<h2>Histograms</h2>",
        '<p class="note">Evaluated agents together, official bins; values beyond the range lie in the outer bins. As in the official '
        "evaluator, steps without a value (the last one or two of speeds and accelerations) lie in a rollout's last bin, and the "
        "metric itself keeps one histogram per agent.</p>",
        f'<div class="charts">{"".join(_histogram_html(h) for h in explanation.histograms)}</div>',
        "<h2>What happened</h2>",
        animation_html(_animation(explanation)),
    ]
    return page_html(f"Scenario {name}", "\n".join(parts), extra_css=_CSS)


def _lead(explanation: Explanation) -> str:
    result, metric = explanation.result, escape(explanation.config.name)
    return (
        f"{result.single_meta_metric.shape[-1]} rollouts reach a meta-metric of {float(result.meta_metric):.4f} (metric {metric}); the "
        f"record itself, as often, reaches {float(explanation.ceiling.meta_metric):.4f}. The difference of {explanation.lost:.4f} is split "
        "below over features, evaluated agents and steps; the parts add up to it."
    )


def _tiles_html(explanation: Explanation) -> str:
    tiles = []
    for name in ("meta_metric", "kinematic", "interactive", "map_based"):
        value, ceiling = float(getattr(explanation.result, name)), float(getattr(explanation.ceiling, name))
        tiles.append(
            f'<div class="card tile"><div class="what">{_words(name)} ({escape(explanation.config.name)})</div>'
            f'<div class="value">{value:.4f}</div><div class="interval">ceiling {ceiling:.4f}</div></div>'
        )
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _features_html(explanation: Explanation) -> str:
    """Features by what they cost, the costliest first."""
    lost = explanation.cost.sum((1, 2))
    rows = []
    for index in np.argsort(-np.nan_to_num(lost), kind="stable"):
        name = FEATURE_NAMES[index]
        values = [float(r.likelihoods[index]) for r in (explanation.result, explanation.ceiling)]
        rows.append(
            f"<tr><th>{_words(name)}</th><td>{explanation.config.weights[index]:.2f}</td><td>{values[0]:.4f}</td>"
            f"<td>{values[1]:.4f}</td>{_heat_cell(lost[index], lost)}</tr>"
        )
    head = "<tr><th>feature</th><th>weight</th><th>likelihood ↑</th><th>of the record</th><th>cost ↓</th></tr>"
    return _table_html(head, rows)


def _agents_html(explanation: Explanation) -> str:
    """Evaluated agents by features."""
    by_agent = explanation.cost.sum(2)  # [F, E]
    shown = [i for i in range(len(FEATURE_NAMES)) if explanation.config.weights[i] > 0]
    head = "".join(f'<th class="narrow">{_words(FEATURE_NAMES[i])}</th>' for i in shown)
    totals = np.nansum(by_agent, axis=0)
    rows = []
    for agent in np.argsort(-totals, kind="stable"):
        cells = "".join(_heat_cell(by_agent[i, agent], by_agent) for i in shown)
        rows.append(
            f"<tr><th>{escape(explanation.agent_names[agent])}</th>{_heat_cell(totals[agent], totals)}{cells}</tr>"
        )
    return _table_html(f"<tr><th>agent</th><th>cost ↓</th>{head}</tr>", rows)


def _strips_html(explanation: Explanation) -> str:
    """The costliest pairs of feature and agent over the 8 seconds."""
    steps = np.nan_to_num(explanation.cost[: len(HISTOGRAM_FEATURES), :, :WHOLE_FUTURE])  # [H, E, T]
    totals = steps.sum(-1)
    order = [divmod(int(i), totals.shape[1]) for i in np.argsort(-totals.ravel(), kind="stable")[:MAX_STRIPS]]
    seen = np.abs(steps)[steps != 0]
    scale = float(np.quantile(seen, 0.95)) if len(seen) else 1.0  # a single step does not make all others pale
    rows = []
    for feature, agent in order:
        label = f"{_words(HISTOGRAM_FEATURES[feature])}, {escape(explanation.agent_names[agent])}"
        rows.append(
            f'<span>{label}</span>{_strip_svg(steps[feature, agent], scale, label)}<span class="amount">{totals[feature, agent]:.4f}</span>'
        )
    num_steps = steps.shape[-1]
    rows.append(
        f'<span class="muted">time after now, cost at right</span><span class="clock"><span>+{STEP_S:.1f} s</span>'
        f"<span>+{num_steps * STEP_S:.0f} s</span></span><span></span>"
    )
    return (
        f'<div class="card strip">{"".join(rows)}</div><p class="note">Red: costs; green: better than the record.</p>'
    )


def _strip_svg(values: Float[np.ndarray, "T"], scale: float, label: str) -> str:
    cells = "".join(
        f'<rect x="{step}" width="1" height="1" fill="var(--{"bad" if value > 0 else "good"})" opacity="{min(abs(value) / scale, 1):.2f}"/>'
        for step, value in enumerate(values.tolist())
        if abs(value) / scale >= 0.01
    )
    return (
        f'<svg viewBox="0 0 {len(values)} 1" preserveAspectRatio="none" role="img" aria-label="{label}" '
        f'shape-rendering="crispEdges">{cells}</svg>'
    )


def _cost_chart(explanation: Explanation) -> Chart:
    """The four costliest histogram features over time, all agents together."""
    steps = np.nan_to_num(explanation.cost[: len(HISTOGRAM_FEATURES), :, :WHOLE_FUTURE]).sum(1)  # [H, T]
    seconds = (np.arange(steps.shape[1]) + 1) * STEP_S
    chosen = np.argsort(-steps.sum(1), kind="stable")[:4]
    curves = [Curve(_words(HISTOGRAM_FEATURES[i]), seconds.tolist(), (1000 * steps[i]).tolist()) for i in chosen]
    return Chart("Cost of a step, all evaluated agents", "seconds after now", "thousandths for 0.1 s", curves)


def _event_chart(explanation: Explanation) -> Chart:
    """How often something bad happens at a step."""
    share = explanation.event_share.mean(1)  # [J, T]
    seconds = ((np.arange(share.shape[1]) + 1) * STEP_S).tolist()
    curves = [Curve(_words(name), seconds, share[row].tolist()) for row, name in enumerate(BERNOULLI_FEATURES)]
    note = (
        "Evaluated agents, where the record is valid. Their cost belongs to the whole future and is in the tables only."
    )
    return Chart("Share of rollouts with an event", "seconds after now", "share", curves, note=note)


def _histogram_html(histogram: FeatureHistogram) -> str:
    """Log and rollouts beside each other in every official bin."""
    bottom = _BAR_HEIGHT - _BOTTOM
    top = max(float(histogram.log_share.max()), float(histogram.rollout_share.max()), 1e-12)
    width = (_BAR_WIDTH - _LEFT) / len(histogram.log_share)
    bars, ticks = [], []
    for k, pair in enumerate(zip(histogram.log_share.tolist(), histogram.rollout_share.tolist())):
        for side, share in enumerate(pair):
            height = share / top * (bottom - _TOP)
            x = _LEFT + (k + 0.08 + 0.42 * side) * width
            bars.append(
                f'<rect x="{x:.1f}" y="{bottom - height:.1f}" width="{0.42 * width:.1f}" height="{height:.1f}" '
                f'fill="var(--series-{side + 1})"><title>{share:.1%}</title></rect>'
            )
    for k in range(0, len(histogram.edges), 2 if len(histogram.edges) > 8 else 1):
        x = _LEFT + k * width
        ticks.append(
            f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{_tick(float(histogram.edges[k]))}</text>'
        )
    title = _words(histogram.feature)
    axis = (
        f'<path class="axis" d="M{_LEFT} {bottom}H{_BAR_WIDTH}"/>'
        f'<text x="{_LEFT - 5}" y="{_TOP + 10}" text-anchor="end">{top:.0%}</text>'
        f'<text class="label" x="{(_LEFT + _BAR_WIDTH) / 2}" y="{_BAR_HEIGHT - 6}" text-anchor="middle">{_UNITS[histogram.feature]}</text>'
    )
    legend = "".join(
        f'<li><span class="swatch" style="background:var(--series-{side + 1})"></span>{name}</li>'
        for side, name in enumerate(("record", "rollouts"))
    )
    return (
        f'<figure class="chart"><figcaption class="chart-title">{title}</figcaption><ul class="legend chart-legend">{legend}</ul>'
        f'<svg viewBox="0 0 {_BAR_WIDTH + 14} {_BAR_HEIGHT}" role="img" aria-label="{title}">{"".join(bars)}{axis}{"".join(ticks)}</svg></figure>'
    )


def _animation(explanation: Explanation) -> Animation:
    scenario = explanation.scenario
    shown = explanation.rollouts.first(MAX_SHOWN_ROLLOUTS)
    panels = [Panel("record", logged_trajectories(scenario)), Panel(f"first {shown.num_rollouts} rollouts", shown)]
    return Animation(f"Scenario {scenario.scenario_id}", build_scene(scenario), panels)


def _table_html(head: str, rows: list[str]) -> str:
    return f'<div class="card scroll"><table class="results"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _heat_cell(value: float, among: Float[np.ndarray, "..."]) -> str:
    """A cost, the redder the larger it is among others; green where it is a gain."""
    if not np.isfinite(value):
        return "<td>none scored</td>"
    heat = abs(value) / max(float(np.nanmax(np.abs(among))), 1e-12)
    text = f"{value:.4f}".replace("-", "−")
    return f'<td class="{"cost" if value > 0 else "gain"}" style="--heat:{heat:.2f}">{text}</td>'


def _tick(edge: float | np.floating) -> str:
    return f"{edge:.3g}".replace("-", "−")


def _words(name: str) -> str:
    words = name.replace("_", " ").replace("map based", "map-based").replace("meta metric", "meta-metric")
    return escape(words)
