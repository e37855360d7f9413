"""A report of evaluations as a page of HTML: how models compare, which scenarios to look at, the runs behind them."""

import math
import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import repeat
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import numpy as np

from rlftsim.evaluation.columns import COLUMNS, DRIFT_COLUMNS, SCORES, Column, format_number
from rlftsim.evaluation.compare import Comparison, PairedDifference, compare, paired_values
from rlftsim.evaluation.learning_curve import run_charts, write_calibration_picture
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.scenario_pages import EvaluatedModels, write_scenario_files
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.files import write_text
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.statistics import MeanInterval
from rlftsim.training.run_folder import describe_environment, flatten, read_metrics, stored_settings
from rlftsim.viewer.chart import Chart, chart_html, label_ticks
from rlftsim.viewer.page import Animation, animation_html, page_html, table_html, tile_html

MAX_ROWS = 1000
"""Rows of the index: of more scenarios those that lose most."""
NOTES = {"oracle": "the log itself: what a perfect simulator would score", "ConstantVelocity": "no model"}
"""Note on an evaluation by the class of the policy."""
SETTINGS = ("epochs", "batch_size", "num_rollouts", "learning_rate", "kl.target", "reward")
"""Settings of a run that a report names."""
SYNTHETIC_NOTE = (
    "The scenarios are synthetic (SUMO traffic on invented streets): these numbers show that the pipeline works and "
    "say nothing about the Waymo Open Motion Dataset."
)


@dataclass(frozen=True)
class ResultRow:
    """A policy's row in the table of a report."""

    name: str
    estimates: Mapping[str, MeanInterval]
    """By column of an `Evaluation`; a missing column was not measured."""
    note: str = ""
    emphasized: bool = False


@dataclass(frozen=True)
class PairedComparison:
    """Two policies on the same scenarios: the differences `second - first` in RMM."""

    first: str
    second: str
    gain: PairedDifference
    differences: Sequence[float] | np.ndarray = ()
    """One per scenario; drawn where given."""

    @classmethod
    def of(cls, comparison: Comparison) -> "PairedComparison":
        """The realism meta-metric of a comparison."""
        _, scores_a, scores_b = paired_values(comparison.a, comparison.b, "meta_metric")
        return cls(comparison.a.name, comparison.b.name, comparison["meta_metric"], scores_b - scores_a)

    @property
    def tone(self) -> Literal["good", "bad", ""]:
        """Good if the whole interval lies above zero, bad if below."""
        low, high = self.gain.interval
        return "good" if low > 0 else "bad" if high < 0 else ""

    @property
    def verdict_text(self) -> str:
        """A sentence made from the interval, or the reason why there is none."""
        if not math.isfinite(self.gain.p_value):
            return f"RMM: {self.gain.verdict}"
        if self.tone:
            word, side = ("higher", "above") if self.tone == "good" else ("lower", "below")
            return (
                f"{_sentence(self.second)} scores {word} than {self.first} in RMM: "
                f"the whole 95 % interval of the mean difference lies {side} zero."
            )
        return (
            f"No difference in RMM between {self.second} and {self.first} can be claimed: "
            "the 95 % interval of the mean difference contains zero."
        )


@dataclass(frozen=True)
class ChartGroup:
    """Charts side by side under a heading."""

    title: str
    charts: Sequence[Chart]
    caption: str = ""
    picture: Path | None = None
    """PNG file below the charts."""


@dataclass(frozen=True)
class ScenarioRow:
    """A scenario with the scores of several policies, and what there is to look at."""

    scenario_id: str
    scores: Sequence[float]
    """RMM of each policy; NaN where a policy has none."""
    lost: float
    """What the judged policy lacks of the score of the log; NaN where either has none."""
    change: float
    """Gain of the judged policy over the first; NaN where either has none."""
    pages: Sequence[str] = ()
    """Address of the page that explains each score; empty = none."""
    film: str = ""
    """Address of a film; empty = none."""


@dataclass(frozen=True)
class ScenarioTable:
    """Scenarios under a heading, a column of scores for each policy."""

    title: str
    names: Sequence[str]
    rows: Sequence[ScenarioRow]
    note: str = ""


@dataclass(frozen=True)
class Report:
    """Contents of the page. Only the title is needed; empty contents are left out."""

    title: str
    summary: Sequence[str] = ()
    """Paragraphs."""
    rows: Sequence[ResultRow] = ()
    table_note: str = ""
    """For instance how many scenarios and rollouts the means are over."""
    comparisons: Sequence[PairedComparison] = ()
    """The first is written large above all else."""
    scenario_tables: Sequence[ScenarioTable] = ()
    chart_groups: Sequence[ChartGroup] = ()
    animations: Sequence[Animation] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    """Configuration, versions, durations, command, commit, ..."""
    footnotes: Sequence[str] = ()


def write_report(path: str | os.PathLike[str], report: Report) -> None:
    """Write the report as a self-contained HTML page, complete or not at all.

    Args:
        path: File of the page, replaced if present.
        report: Contents of the page.
    """
    write_text(Path(path), report_html(report))


def report_html(report: Report) -> str:
    """The page as HTML; empty contents are left out."""
    lead = "".join(f'<p class="lead">{escape(text)}</p>' for text in report.summary)
    # 1. The result.
    sections = [
        f"<header><h1>{escape(report.title)}</h1>{lead}</header>",
        _tiles_html(report),
        _table_html("Results", report.rows, COLUMNS, f"{report.table_note} {_ERRORS} {_ARROWS_MEAN}"),
        *(_comparison_html(comparison) for comparison in report.comparisons),
        _table_html("Drift from the log", report.rows, DRIFT_COLUMNS, f"{_DRIFT_MEANS} {_ERRORS}"),
    ]
    # 2. Pictures of it, and of the runs behind it.
    if report.animations:
        players = "\n".join(animation_html(animation) for animation in report.animations)
        sections.append(f'<h2>Scenarios in motion</h2><p class="muted">{_WHO_MOVES}</p>{players}')
    sections += [_scenarios_html(table) for table in report.scenario_tables if table.rows]
    for group in report.chart_groups:
        caption = f'<p class="muted">{escape(group.caption)}</p>' if group.caption else ""
        charts = "".join(chart_html(chart) for chart in group.charts)
        picture = _picture_html(group.picture, group.title) if group.picture else ""
        body = f'<h2>{escape(group.title)}</h2>{caption}<div class="charts">{charts}</div>{picture}'
        sections.append(body if charts else "")
    # 3. The facts to repeat it.
    if report.facts:
        facts = (f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>" for name, value in report.facts.items())
        sections.append(f'<h2>How this was made</h2><dl class="card facts">{"".join(facts)}</dl>')
    if report.footnotes:
        notes = "".join(f"<li>{escape(text)}</li>" for text in report.footnotes)
        sections.append(f'<h2>Notes</h2><ol class="footnotes">{notes}</ol>')
    return page_html(report.title, "\n".join(s for s in sections if s))


def _sentence(text: str) -> str:
    """With a capital first letter."""
    return text[:1].upper() + text[1:]


def _tiles_html(report: Report) -> str:
    """The two compared means and the difference, large."""
    if not report.comparisons:
        return ""
    comparison = report.comparisons[0]
    tiles = []
    by_name = {row.name: row.estimates.get("meta_metric") for row in report.rows}
    for name in (comparison.first, comparison.second):
        estimate = by_name.get(name)
        if estimate is not None and math.isfinite(estimate.mean):
            limits = _interval_text(estimate.interval)
            tiles.append(tile_html(f"RMM, {name}", format_number(estimate.mean, 4), limits))
    limits = _interval_text(comparison.gain.interval)
    tiles.append(
        tile_html("mean paired difference", _format_signed(comparison.gain.difference), limits, comparison.tone)
    )
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _format_signed(difference: float) -> str:
    return ("+" if difference > 0 else "") + format_number(difference, 4)


def _interval_text(interval: tuple[float, float]) -> str:
    """Both ends in words; empty without an interval, as over fewer than two scenarios."""
    low, high = (format_number(value, 4) for value in interval)
    return f"95 % interval {low} to {high}" if math.isfinite(interval[0]) else ""


_ERRORS = "Mean ± standard error over scenarios; point at a number for its 95 % interval."
_WHO_MOVES = "The model moves every agent, the ego included; the first 1.1 s are logged."
_ARROWS_MEAN = "↑ higher is better, ↓ lower is better."
_DRIFT_MEANS = (
    "The meta-metric rewards slow traffic, which hits nothing and stays on the road; here slowness shows. Numbers "
    "without an arrow are best near the log's own, the row of the oracle."
)


def _table_html(title: str, rows: Sequence[ResultRow], columns: Sequence[Column], note: str) -> str:
    """A table with a heading and a note below; empty where no row has any of the columns."""
    columns = [column for column in columns if any(column.source in row.estimates for row in rows)]
    if not columns:
        return ""
    headings = [f'<abbr title="{escape(c.meaning)}; {c.direction_text}">{escape(c.label)}</abbr>' for c in columns]
    body = []
    for row in rows:
        below = f'<span class="note">{escape(row.note)}</span>' if row.note else ""
        style = ' class="emphasized"' if row.emphasized else ""
        cells = "".join(_cell_html(column, row.estimates.get(column.source)) for column in columns)
        body.append(f'<tr{style}><th scope="row">{escape(row.name)}{below}</th>{cells}</tr>')
    return (
        f"<h2>{escape(title)}</h2>{table_html(['policy', *headings], body)}"
        f'<p class="note" style="margin-top:10px">{escape(note.strip())}</p>'
    )


def _cell_html(column: Column, estimate: MeanInterval | None) -> str:
    """A cell with the 95 % interval as the tooltip."""
    if estimate is None or not math.isfinite(estimate.mean):
        return "<td>–</td>"
    if not math.isfinite(estimate.standard_error):
        return f"<td>{column.text(estimate.mean)}</td>"
    low, high = (column.text(limit) for limit in estimate.interval)
    error = f'<span class="error">± {column.text(estimate.standard_error)}</span>'
    return f'<td title="95 % interval {low} to {high}">{column.text(estimate.mean)} {error}</td>'


def _scenarios_html(table: ScenarioTable) -> str:
    """Scenarios by rows; a score is a link to the page that explains the score, where there is one."""
    has_films = any(row.film for row in table.rows)
    headings = ("scenario", *map(escape, table.names), "lost ↓", *(["change"] if len(table.names) > 1 else []))
    headings = (*headings, *(["film"] if has_films else []))
    body = []
    for row in table.rows:
        scores = [_link(page, format_number(score, 4)) for score, page in zip(row.scores, row.pages or repeat(""))]
        change = [f"{row.change:+.4f}".replace("-", "−")] if len(table.names) > 1 else []
        cells = [*scores, format_number(row.lost, 4), *change, *([_link(row.film, "film")] if has_films else [])]
        texts = "".join(f"<td>{'–' if cell == 'nan' or cell == '+nan' else cell}</td>" for cell in cells)
        body.append(f'<tr><th scope="row">{escape(row.scenario_id)}</th>{texts}</tr>')
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f"<h2>{escape(table.title)}</h2>{note}{table_html(headings, body, is_long=True)}"


def _picture_html(path: Path, title: str) -> str:
    """The picture inside of the page, so that the page stays a single file."""
    source = f"data:image/png;base64,{b64encode(path.read_bytes()).decode()}"
    return f'<p><img class="card" style="width: min(100%, 640px)" src="{source}" alt="{escape(title)}"></p>'


def _link(address: str, text: str) -> str:
    return f'<a href="{escape(quote(address))}">{text}</a>' if address else text


def _comparison_html(comparison: PairedComparison) -> str:
    gain = comparison.gain
    p_text = "p < 0.0001" if gain.p_value < 1e-4 else f"p = {gain.p_value:.2g}"
    test = f"by {gain.num_clusters} street networks" if gain.num_clusters else "paired t-test"
    tested = f"{_interval_text(gain.interval)}, {p_text} ({test}), " if math.isfinite(gain.p_value) else ""
    return (
        f"<h2>{escape(_sentence(comparison.second))} against {escape(comparison.first)}, scenario by scenario</h2>"
        f'<div class="card comparison"><div><p class="verdict">{escape(comparison.verdict_text)}</p>'
        f"<p>Mean difference in RMM {_format_signed(gain.difference)}, {tested}{gain.count} scenarios.</p></div>"
        f"{_difference_svg(comparison)}</div>"
    )


def _difference_svg(comparison: PairedComparison) -> str:
    """A dot per scenario, the mean and the interval below, zero dashed."""
    width, margin, base = 520, 24, 108
    mean, interval = comparison.gain.difference, comparison.gain.interval
    # one dot per scenario, from left to right: `_stacked` needs them sorted
    dots = np.sort(np.asarray(comparison.differences, float))
    dots = dots[np.isfinite(dots)]
    # zero belongs to the axis even if all differences lie on one side
    values = np.concatenate([dots, interval, [0.0, mean]])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low == high:
        low, high = low - 1, high + 1

    def across(value: float) -> float:
        return margin + (value - low) / (high - low) * (width - 2 * margin)

    tone, shapes = f"var(--{comparison.tone or 'accent'})", []
    for tick, label in label_ticks(low, high, 6):
        shapes.append(f'<path class="tick" d="M{across(tick):.1f} {base}v5"/>')
        shapes.append(f'<text x="{across(tick):.1f}" y="{base + 18}" text-anchor="middle">{label}</text>')
    shapes.append(f'<path class="axis" d="M{margin} {base}H{width - margin}"/>')
    shapes.append(f'<path class="zero" d="M{across(0.0):.1f} 4V{base}"/>')
    for value, height in zip(dots, _stacked(np.array([across(v) for v in dots]), diameter=7.0)):
        color = "var(--good)" if value > 0 else "var(--bad)" if value < 0 else "var(--muted)"
        # dots that touch are stacked, up to the upper border
        y = 70 - min(height * 7, 62)
        shapes.append(f'<circle cx="{across(value):.1f}" cy="{y}" r="3.2" fill="{color}" opacity=".65"/>')
    if math.isfinite(interval[0]):  # no interval over a single scenario or street network
        start, stop = (across(v) for v in interval)
        shapes.append(f'<path d="M{start:.1f} 91H{stop:.1f}" stroke="{tone}" stroke-width="4" stroke-linecap="round"/>')
    shapes.append(f'<circle cx="{across(mean):.1f}" cy="91" r="6.5" fill="{tone}"/>')
    dots_label = "a dot per scenario, " if len(dots) else ""
    caption = f"{dots_label}mean and 95 % interval; {escape(comparison.second)} minus {escape(comparison.first)}"
    shapes.append(f'<text x="{width / 2}" y="{base + 38}" text-anchor="middle">{caption}</text>')
    return f'<svg viewBox="0 0 {width} 152" role="img" aria-label="{caption}">{"".join(shapes)}</svg>'


def _stacked(across: np.ndarray, diameter: float) -> list[int]:
    """For sorted positions, the lowest row in which each dot touches no earlier dot."""
    last: list[float] = []  # position of the last dot of each row
    rows = []
    for x in across:
        row = next((i for i, end in enumerate(last) if x - end >= diameter), len(last))
        last[row : row + 1] = [float(x)]
        rows.append(row)
    return rows


def build_report(
    models: EvaluatedModels,
    out: Path,
    *,
    runs: Sequence[Path] = (),
    num_listed: int = 10,
    num_played: int = 3,
    jobs: int = 1,
    title: str = "",
    summary: Sequence[str] = (),
    facts: Mapping[str, str] | None = None,
) -> Report:
    """Report of evaluations, for `write_report`; writes the pages and films that the report links to.

    The second evaluation is the judged one, compared with the first: the worst scenarios are those in which it loses
    most of the log's score, the most changed ones those in which both differ most. A single one is judged alone.

    Args:
        models: Evaluations on the same scenarios, and the models and scenarios at hand.
        out: Folder of the report.
        runs: Folders of training runs, for their learning curves and settings.
        num_listed: Number of the worst scenarios, and of the most changed ones, with pages and films.
        num_played: Number of scenarios that play in the report: those that gained most, and a middle one.
        jobs: Processes that write pages and films.
        title: Heading; empty = names of the evaluations.
        summary: Paragraphs below the heading.
        facts: Further facts to repeat it, by name.

    Raises:
        DataError: Evaluations that cannot be compared, or a scenario that the data set does not have.
    """
    first, *others = models.evaluations
    judged = others[0] if others else first
    # also the score of the log depends on metric and number of rollouts
    compared = [compare(first, other) for other in others]
    compared = [comparison for comparison in compared if comparison.b.provenance.policy != "oracle"]
    rows = rank_scenarios(models.evaluations)
    changed = sorted((row for row in rows if np.isfinite(row.change)), key=lambda row: -abs(row.change))
    changed = changed[:num_listed] if others else []
    files, animations = {}, []
    if models.can_simulate:
        scenario_ids = dict.fromkeys(row.scenario_id for row in (*rows[:num_listed], *changed))
        files = write_scenario_files(models, list(scenario_ids), out, jobs=jobs)
        animations = _animate(models, rows, num_played)
    listed, changed = (
        [replace(row, **files.get(row.scenario_id, {})) for row in selected] for selected in (rows[:MAX_ROWS], changed)
    )
    names = [evaluation.name for evaluation in models.evaluations]
    most_lost = f"Scenarios, those in which {judged.name} loses most first"
    environment = describe_environment()
    return Report(
        title=title or f"{judged.name} against {first.name}" if others else title or first.name,
        summary=summary,
        rows=[
            ResultRow(
                e.name,
                {column.source: e.mean_and_error(column.source) for column in (*SCORES, *DRIFT_COLUMNS)},
                _note_row(e, first),
                emphasized=e is judged,
            )
            for e in models.evaluations
        ],
        table_note=(
            f"{len(first)} held-out scenarios, {first.config.num_rollouts} rollouts each, metric "
            f"{first.config.metric}. {first.data_note}"
        ).rstrip(),
        comparisons=list(map(PairedComparison.of, compared)),
        animations=animations,
        scenario_tables=[
            ScenarioTable(f"Most changed scenarios, {judged.name} against {first.name}", names, changed),
            ScenarioTable(most_lost, names, listed, _describe_index(models, rows)),
        ],
        chart_groups=[_chart_run(run) for run in runs],
        facts={
            "command": environment["command"],
            "machine": environment["machine"],
            "versions": ", ".join(f"{name} {number}" for name, number in environment["packages"].items()),
            "commit": environment["commit"] or "installed package",
            **{f"run {run.name}": _describe_run(run) for run in runs},
            **(facts or {}),
        },
        footnotes=[SYNTHETIC_NOTE]
        if first.provenance.manifest_sha256 == hash_manifest(dataset_folder("synthetic"))
        else [],
    )


def _note_row(evaluation: Evaluation, first: Evaluation) -> str:
    """The note of a policy, and the number of scenarios where the first evaluation has more or fewer."""
    count = f"scenarios: {len(evaluation)}" if len(evaluation) != len(first) else ""
    return ", ".join(filter(None, [NOTES.get(evaluation.provenance.policy, ""), count]))


def rank_scenarios(evaluations: Sequence[Evaluation]) -> list[ScenarioRow]:
    """Scenarios of the judged evaluation, the second or only one: those in which it loses most first.

    Args:
        evaluations: Evaluations; where the oracle is among them, a loss is what lacks of its score, else of 1.
    """
    judged = evaluations[min(1, len(evaluations) - 1)]
    scores = [dict(zip(e.scenario_ids, e["meta_metric"].tolist())) for e in evaluations]
    oracle = next((by_id for e, by_id in zip(evaluations, scores) if e.provenance.policy == "oracle"), None)
    rows = []
    for scenario_id in judged.scenario_ids:
        values = [by_id.get(scenario_id, np.nan) for by_id in scores]
        score = values[min(1, len(values) - 1)]
        ceiling = 1.0 if oracle is None else oracle.get(scenario_id, np.nan)
        rows.append(ScenarioRow(scenario_id, values, ceiling - score, score - values[0]))
    return sorted(rows, key=lambda row: -np.nan_to_num(row.lost, nan=-np.inf))


def _animate(models: EvaluatedModels, rows: Sequence[ScenarioRow], num_played: int) -> list[Animation]:
    """Scenarios that gained most, and an ordinary one; of a single evaluation those that lose most."""
    by_gain = sorted((row for row in rows if np.isfinite(row.change)), key=lambda row: -row.change)
    by_gain = by_gain if len(models.evaluations) > 1 else list(rows)
    # The largest gains first, then the one in the middle of the order.
    selected = dict.fromkeys((*range(min(max(num_played - 1, 1), len(by_gain))), len(by_gain) // 2))
    animations = []
    for row in [by_gain[position] for position in list(selected)[:num_played] if by_gain]:
        caption = f"lost {row.lost:.3f}"
        if len(models.evaluations) > 1:
            first, judged = (evaluation.name for evaluation in models.evaluations[:2])
            caption = f"RMM of {judged} minus {first}: {row.change:+.3f}"
        animations.append(models.animate(row.scenario_id, caption))
    return animations


def _describe_index(models: EvaluatedModels, rows: Sequence[ScenarioRow]) -> str:
    """What the columns of the index mean."""
    has_oracle = any(e.provenance.policy == "oracle" for e in models.evaluations)
    pages = " A score is a link to the page that says where it was lost." if models.can_simulate else ""
    left_out = f" {len(rows) - MAX_ROWS} further scenarios lose less." if len(rows) > MAX_ROWS else ""
    return (
        f"RMM of each evaluation. Lost: what lacks of {'the RMM of the log' if has_oracle else '1'}.{pages}{left_out}"
    )


def _chart_run(run: Path) -> ChartGroup:
    settings, lines = flatten(stored_settings(run)), read_metrics(run)
    caption = ""
    if lines and "rmm" in lines[0]:
        caption = (
            f"Training rollouts come in groups of {settings.get('num_rollouts')}, so their RMM is not comparable with "
            "the table's."
        )
    picture = run / "model" / "calibration.png"
    return ChartGroup(
        f"Training: {run.name}",
        run_charts(lines, settings.get("kl.target")),
        caption,
        picture if picture.exists() else write_calibration_picture(run / "model"),
    )


def _describe_run(run: Path) -> str:
    settings = flatten(stored_settings(run))
    values = [f"{name.replace('_', ' ')} {settings[name]}" for name in SETTINGS if name in settings]
    return ", ".join([f"{len(read_metrics(run))} updates", *values])
