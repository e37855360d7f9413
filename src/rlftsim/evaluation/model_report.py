"""Report of evaluations: how models compare, which scenarios to look at, and the runs that made the models."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rlftsim.evaluation.columns import DRIFT_COLUMNS, SCORES
from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.learning_curve import run_charts, write_calibration_picture
from rlftsim.evaluation.report import ChartGroup, PairedComparison, Report, ResultRow, ScenarioRow, ScenarioTable
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.scenario_pages import EvaluatedModels, write_scenario_files
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.training.run_folder import describe_environment, flatten, read_metrics, stored_settings
from rlftsim.viewer.page import Animation

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
    comparisons = [compare(first, other) for other in others if other.provenance.policy != "oracle"]
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
    environment = describe_environment()
    return Report(
        title=title or f"{judged.name} against {first.name}" if others else title or first.name,
        summary=summary,
        rows=[
            ResultRow(
                e.name,
                {column.source: e.mean_and_error(column.source) for column in (*SCORES, *DRIFT_COLUMNS)},
                NOTES.get(e.provenance.policy, ""),
                emphasized=e is judged,
            )
            for e in models.evaluations
        ],
        table_note=(
            f"{len(first)} held-out scenarios, {first.config.num_rollouts} rollouts each, metric "
            f"{first.config.metric}. {first.data_note}"
        ).rstrip(),
        comparisons=[PairedComparison.of(comparison) for comparison in comparisons],
        animations=animations,
        animations_note="The model moves every agent, the ego included; the first 1.1 s are logged.",
        scenario_tables=[
            ScenarioTable(
                f"Most changed scenarios, {judged.name} against {first.name}",
                names,
                changed,
            ),
            ScenarioTable(
                f"Scenarios, those in which {judged.name} loses most first",
                names,
                listed,
                _describe_index(models, rows),
            ),
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
