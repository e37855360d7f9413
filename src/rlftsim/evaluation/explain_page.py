"""Explanations of scores as self-contained HTML pages: costs by feature, agent and step, and the histograms."""

import hashlib
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from rlftsim import __version__
from rlftsim.errors import DataError
from rlftsim.evaluation.explain import WHOLE_FUTURE, Explanation, FeatureHistogram, explain
from rlftsim.evaluation.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.evaluation.scenario_source import ScenarioSource, has_road_edge, hash_source, open_scenarios
from rlftsim.evaluation.score_files import ScoreConfig, check_entries, hash_entries
from rlftsim.jobs.files import remove_folder, remove_temporaries, write_atomically, write_text
from rlftsim.jobs.folder import Lease, check_folder
from rlftsim.jobs.items import WholeFiles, run_items
from rlftsim.jobs.runner import Advance, Joining, Runner, Share, choose_runner
from rlftsim.realism.config import FEATURE_NAMES, HISTOGRAM_FEATURES
from rlftsim.scenario.types import STEP_S
from rlftsim.viewer.page import Animation, Panel, animation_html, page_html, read_asset, table_html, tile_html
from rlftsim.viewer.scene import build_scene, logged_trajectories

Item = TypeVar("Item")
MAX_STRIPS = 10
"""Rows of (feature, agent) drawn over time."""
MAX_SHOWN_ROLLOUTS = 8
_UNITS = {
    "linear_speed": "m/s", "linear_acceleration": "m/s²", "angular_speed": "rad/s", "angular_acceleration": "rad/s²",
    "distance_to_nearest_object": "m", "time_to_collision": "s", "distance_to_road_edge": "m",
}  # fmt: skip
_BAR_WIDTH, _BAR_HEIGHT, _LEFT, _BOTTOM, _TOP = 380, 190, 40, 46, 8


def explain_rollouts(
    rollouts: str | PathLike[str],
    scenarios: str | PathLike[str],
    out: str | PathLike[str],
    config: ScoreConfig = ScoreConfig(),  # noqa: B008
    *,
    runner: Runner | None = None,
) -> list[Path]:
    """Write `out/<scenario id>.html` for every scenario with rollouts, anew. Returns the pages.

    Further sets of rollouts of the same scenario are numbered: `<scenario id>-2.html`. Until all pages are there, the
    finished pages lie in a separate folder inside `out`: interrupted in any way, the same call goes on.

    Args:
        rollouts: Npz, submission file or a folder of either, see `find_rollouts`.
        scenarios: Converted data set, or tfrecords (file, folder or glob).
        out: Folder of the pages, made if missing.
        config: Metric, handling of missing maps and scenarios, processes.
        runner: Runner of the work in place of `config.jobs` processes, see `rlftsim.jobs.runner`.

    Raises:
        DataError: Rollouts or scenarios that `score_rollouts` refuses, or another driver at work on these pages.
        SetAside, Unfinished: See `run_items`.
    """
    check_folder(Path(out), "results")
    entries, source = find_rollouts(rollouts)[: config.limit], open_scenarios(scenarios)
    check_entries(entries, source, config, Path(scenarios))
    # Pages are named before any is written, so that the names do not depend on the order of the processes.
    items: dict[str, RolloutEntry] = {}
    for entry in entries:
        name = entry.scenario_id.replace("/", "_") or "scenario"
        numbered = (name, *(f"{name}-{k}" for k in range(2, len(entries) + 2)))
        items[next(page for page in (f"{n}.html" for n in numbered) if page not in items)] = entry
    identity = repr((hash_entries(entries), hash_source(source), config.metric, config.missing_map, __version__))
    runner = runner or choose_runner(config.num_jobs, len(items))
    return write_files("explain", items, partial(_write_page, source, config), Path(out), identity, runner)


def write_files(
    title: str, items: Mapping[str, Item], write: Callable[[Path, Item], None], out: Path, identity: str, runner: Runner
) -> list[Path]:
    """Write a file for each item; a call that was interrupted goes on. Returns the files that are not empty.

    Args:
        title: Name of the work, in front of the progress bar.
        items: Items by name of the file, such as "a.html".
        write: Function that writes the file of an item, whole or not at all; picklable for other processes.
        out: Folder of the files, made if missing. Unfinished work lies in a folder of its own inside. Shares leave an
            empty folder there, by which a share that is repeated knows that all is done.
        identity: Text that is equal for the same work.
        runner: Runner of the items.

    Raises:
        DataError: Another driver at work on these files.
        SetAside, Unfinished: See `run_items`.
    """
    folder = out / f"pages-{hashlib.sha256(identity.encode()).hexdigest()[:12]}.parts"
    done, is_shared = folder.with_suffix(".done"), isinstance(runner, Share | Joining)
    if done.exists():
        remove_folder(done, items)
        written = [out / name for name in items if (out / name).exists()]
        if is_shared and written:  # a share alone would begin its files anew, and leave them
            done.mkdir(exist_ok=True)
            return written
    with Lease(folder / ".lock", runner, "works in") as lease:
        finished = run_items(
            title, list(items.items()), partial(_write_file, write, folder), lease=lease,
            format=WholeFiles(folder, itemgetter(0), _read_page),
        )  # fmt: skip
        files = [file for file in finished if file.stat().st_size]
        remove_temporaries(out / name for name in items)  # of a process that was killed at this very copy
        for file in files:
            write_atomically(out / file.name, partial(shutil.copyfile, file))
        lease.remove()
        # renamed at once: what is gone from the folder is done again
        remove_folder(folder if done.exists() else folder.rename(done), items)
        if is_shared:
            done.mkdir(exist_ok=True)
    return [out / file.name for file in files]


def _write_file(
    write: Callable[[Path, Any], None],
    folder: Path,
    item: tuple[str, Any],
    advance: Advance,
    is_stopped: Callable[[], bool],
) -> None:
    """Write the file of an item, unless the work is being stopped."""
    if not is_stopped():
        write(folder / item[0], item[1])
        advance(1)


def _read_page(path: Path) -> str:
    """Text of a page, empty where there is nothing to explain; nothing of a film.

    Raises:
        DataError: The page is cut off.
    """
    html = path.read_text(encoding="utf-8", errors="replace") if path.suffix == ".html" else ""
    if html and not html.endswith("</html>\n"):
        raise DataError(f"{path}: its end is missing.")
    return html


def _write_page(source: ScenarioSource, config: ScoreConfig, path: Path, entry: RolloutEntry) -> None:
    """Write a page, empty for a scenario without a score."""
    scenario = source.by_id(entry.scenario_id) if entry.scenario_id in source else None
    html = ""
    # Without road edges there is no score to explain; scoring says so.
    if scenario is not None and (config.missing_map == "error" or has_road_edge(scenario)):
        html = explanation_html(explain(scenario, read_states(entry), config.official_metric))
    write_text(path, html)


def explanation_html(explanation: Explanation, policy: str = "") -> str:
    """The page of an explanation as HTML.

    Args:
        explanation: Score of a scenario with its costs.
        policy: Name of what made the rollouts, for the heading; empty = not named.
    """
    heading = f"Scenario {explanation.scenario.scenario_id}{f', {policy}' if policy else ''}"
    name, result = explanation.scenario.scenario_id, explanation.result
    metric = escape(explanation.config.name)
    lead = (
        f"{result.single_meta_metric.shape[-1]} rollouts reach a meta-metric of {float(result.meta_metric):.4f} "
        f"(metric {metric}); the log itself, as often, reaches {float(explanation.ceiling.meta_metric):.4f}. The "
        f"difference of {explanation.lost:.4f} is split below over features, evaluated agents and steps; the parts add "
        "up to it."
    )
    tiles = "".join(
        tile_html(
            f"{_words(score)} ({explanation.config.name})",
            f"{float(getattr(result, score)):.4f}",
            f"ceiling {float(getattr(explanation.ceiling, score)):.4f}",
        )
        for score in ("meta_metric", "kinematic", "interactive", "map_based")
    )
    # few: the page holds every drawn trajectory
    first_rollouts = explanation.rollouts.first(MAX_SHOWN_ROLLOUTS)
    panels = [
        Panel("logged", logged_trajectories(explanation.scenario)),
        Panel(f"first {first_rollouts.num_rollouts} rollouts", first_rollouts),
    ]
    sections = [
        f"<h1>{escape(heading)}</h1>",
        f'<p class="lead">{lead}</p>',
        f'<div class="tiles">{tiles}</div>',
        "<h2>Which feature</h2>",
        _features_html(explanation),
        "<h2>Which agent</h2>",
        _agents_html(explanation),
        "<h2>Which steps</h2>",
        _strips_html(explanation),
        "<h2>Histograms</h2>",
        '<p class="note">Evaluated agents together, official bins; values beyond the range lie in the outer bins. As '
        "in the official evaluator, steps without a value (the last one or two of speeds and accelerations) lie in a "
        "rollout's last bin, and the metric itself keeps one histogram per agent.</p>",
        f'<div class="charts">{"".join(_histogram_html(h) for h in explanation.histograms)}</div>',
        "<h2>What happened</h2>",
        animation_html(Animation(f"Scenario {name}", build_scene(explanation.scenario), panels)),
    ]
    return page_html(heading, "\n".join(sections), extra_css=read_asset("explain.css"))


def _features_html(explanation: Explanation) -> str:
    """Features with their costs, the costliest first."""
    lost = explanation.cost.sum((1, 2))  # [F]
    rows = []
    for index in np.argsort(-np.nan_to_num(lost), kind="stable"):
        name = FEATURE_NAMES[index]
        values = [float(r.likelihoods[index]) for r in (explanation.result, explanation.ceiling)]
        rows.append(
            f"<tr><th>{_words(name)}</th><td>{explanation.config.weights[index]:.2f}</td><td>{values[0]:.4f}</td>"
            f"<td>{values[1]:.4f}</td>{_heat_cell(lost[index], lost)}</tr>"
        )
    return table_html(("feature", "weight", "likelihood ↑", "of the log", "cost ↓"), rows)


def _agents_html(explanation: Explanation) -> str:
    """Evaluated agents by features."""
    by_agent = explanation.cost.sum(2)  # [F, E]
    # features that this year's metric does not count have no column
    columns = [i for i in range(len(FEATURE_NAMES)) if explanation.config.weights[i] > 0]
    headings = [f'<span class="narrow">{_words(FEATURE_NAMES[i])}</span>' for i in columns]
    totals = np.nansum(by_agent, axis=0)  # [E]; NaN: a feature without a scored step
    rows = []
    for agent in np.argsort(-totals, kind="stable"):
        cells = "".join(_heat_cell(by_agent[i, agent], by_agent) for i in columns)
        rows.append(
            f"<tr><th>{escape(explanation.agent_names[agent])}</th>{_heat_cell(totals[agent], totals)}{cells}</tr>"
        )
    return table_html(("agent", "cost ↓", *headings), rows)


def _strips_html(explanation: Explanation) -> str:
    """The costliest pairs of feature and agent over the 8 seconds."""
    steps = np.nan_to_num(explanation.cost[: len(HISTOGRAM_FEATURES), :, :WHOLE_FUTURE])  # [H, E, T]
    totals = steps.sum(-1)  # [H, E]
    order = [divmod(int(i), totals.shape[1]) for i in np.argsort(-totals.ravel(), kind="stable")[:MAX_STRIPS]]
    magnitudes = np.abs(steps)[steps != 0]  # [steps with a cost]
    # a quantile, so that a single step does not make all others pale
    scale = float(np.quantile(magnitudes, 0.95)) if len(magnitudes) else 1.0
    rows = []
    for feature, agent in order:
        label = f"{_words(HISTOGRAM_FEATURES[feature])}, {escape(explanation.agent_names[agent])}"
        # A step is a bar one unit wide, the stronger colored the more it costs; invisible ones are left out.
        values = steps[feature, agent].tolist()
        bars = "".join(
            f'<rect x="{step}" width="1" height="1" fill="var(--{"bad" if value > 0 else "good"})" '
            f'opacity="{min(abs(value) / scale, 1):.2f}"/>'
            for step, value in enumerate(values)
            if abs(value) / scale >= 0.01
        )
        rows.append(
            f'<span>{label}</span><svg viewBox="0 0 {len(values)} 1" preserveAspectRatio="none" role="img" '
            f'aria-label="{label}" shape-rendering="crispEdges">{bars}</svg>'
            f'<span class="amount">{totals[feature, agent]:.4f}</span>'
        )
    num_steps = steps.shape[-1]
    rows.append(
        f'<span class="muted">time after now, cost at right</span><span class="clock"><span>+{STEP_S:.1f} s</span>'
        f"<span>+{num_steps * STEP_S:.0f} s</span></span><span></span>"
    )
    return f'<div class="card strip">{"".join(rows)}</div><p class="note">Red: costs; green: better than the log.</p>'


def _histogram_html(histogram: FeatureHistogram) -> str:
    """Log and rollouts beside each other in every official bin."""
    bottom = _BAR_HEIGHT - _BOTTOM
    # the tallest bar fills the height; 1e-12 for a feature without a scored step
    top = max(float(histogram.log_fraction.max()), float(histogram.rollout_fraction.max()), 1e-12)
    width = (_BAR_WIDTH - _LEFT) / len(histogram.log_fraction)
    bars, ticks = [], []
    for k, pair in enumerate(zip(histogram.log_fraction.tolist(), histogram.rollout_fraction.tolist())):
        for side, fraction in enumerate(pair):
            height = fraction / top * (bottom - _TOP)
            # the pair takes 84 % of a bin's width, 8 % stay free on either side
            x = _LEFT + (k + 0.08 + 0.42 * side) * width
            bars.append(
                f'<rect x="{x:.1f}" y="{bottom - height:.1f}" width="{0.42 * width:.1f}" height="{height:.1f}" '
                f'fill="var(--series-{side + 1})"><title>{fraction:.1%}</title></rect>'
            )
    # every other edge where there are many: labels would overlap
    for k in range(0, len(histogram.edges), 2 if len(histogram.edges) > 8 else 1):
        edge = f"{float(histogram.edges[k]):.3g}".replace("-", "−")
        ticks.append(f'<text x="{_LEFT + k * width:.1f}" y="{bottom + 15}" text-anchor="middle">{edge}</text>')
    title = _words(histogram.feature)
    axis = (
        f'<path class="axis" d="M{_LEFT} {bottom}H{_BAR_WIDTH}"/>'
        f'<text x="{_LEFT - 5}" y="{_TOP + 10}" text-anchor="end">{top:.0%}</text>'
        f'<text class="label" x="{(_LEFT + _BAR_WIDTH) / 2}" y="{_BAR_HEIGHT - 6}" text-anchor="middle">'
        f"{_UNITS[histogram.feature]}</text>"
    )
    legend = "".join(
        f'<li><span class="swatch" style="background:var(--series-{side + 1})"></span>{name}</li>'
        for side, name in enumerate(("log", "rollouts"))
    )
    return (
        f'<figure class="chart"><figcaption class="chart-title">{title}</figcaption>'
        f'<ul class="legend chart-legend">{legend}</ul>'
        f'<svg viewBox="0 0 {_BAR_WIDTH + 14} {_BAR_HEIGHT}" role="img" aria-label="{title}">'
        f"{''.join(bars)}{axis}{''.join(ticks)}</svg></figure>"
    )


def _heat_cell(value: float, among: Float[np.ndarray, "..."]) -> str:
    """A cost, the redder the larger among all costs; green for a gain."""
    if not np.isfinite(value):
        return "<td>none scored</td>"
    heat = abs(value) / max(float(np.nanmax(np.abs(among))), 1e-12)
    text = f"{value:.4f}".replace("-", "−")
    return f'<td class="{"cost" if value > 0 else "gain"}" style="--heat:{heat:.2f}">{text}</td>'


def _words(name: str) -> str:
    words = name.replace("_", " ").replace("map based", "map-based").replace("meta metric", "meta-metric")
    return escape(words)
