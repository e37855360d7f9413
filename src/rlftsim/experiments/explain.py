"""Pages that explain scores: one self-contained page per scenario with rollouts in files."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rlftsim.experiments.explain_page import explanation_html
from rlftsim.experiments.explanation import explain
from rlftsim.experiments.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.experiments.scenario_source import ScenarioSource, open_scenarios
from rlftsim.experiments.score import ScoreConfig, check_entries, has_road_edge
from rlftsim.files import write_text
from rlftsim.processor import one_thread
from rlftsim.progress import progress_bar
from rlftsim.realism import metric_by_name
from rlftsim.workers import run_tasks


def explain_rollouts(
    rollouts: Path,
    scenarios: Path,
    out: Path,
    config: ScoreConfig = ScoreConfig(),  # noqa: B008
    *,
    show_progress: bool = True,
) -> list[Path]:
    """Write `out/<scenario id>.html` for every scenario with rollouts, anew. Returns the pages.

    Further sets of rollouts of the same scenario are numbered: `<scenario id>-2.html`.

    Raises:
        DataError: as `score_rollouts`.
    """
    entries, source = find_rollouts(rollouts)[: config.limit], open_scenarios(scenarios)
    check_entries(entries, source, config, scenarios)
    pages = {out / f"{name}.html": entry for name, entry in _page_names(entries).items()}
    with progress_bar("explain", len(pages), show=show_progress) as advance, one_thread():
        written = run_tasks(
            partial(_write_page, source, config), list(pages.items()), jobs=config.num_jobs, advance=advance
        )
    return [page for page, is_written in zip(pages, written) if is_written]


def _page_names(entries: Sequence[RolloutEntry]) -> dict[str, RolloutEntry]:
    names: dict[str, RolloutEntry] = {}
    for entry in entries:
        name = entry.scenario_id.replace("/", "_") or "scenario"
        free = (n for n in (name, *(f"{name}-{k}" for k in range(2, len(entries) + 2))) if n not in names)
        names[next(free)] = entry
    return names


def _write_page(
    source: ScenarioSource,
    config: ScoreConfig,
    item: tuple[Path, RolloutEntry],
    advance: Callable[[int], None],
    is_stopped: Callable[[], bool],
) -> bool:
    """Write one page; False where there is nothing to explain."""
    path, entry = item
    if is_stopped():
        return False
    scenario = source.by_id(entry.scenario_id) if entry.scenario_id in source else None
    # Without road edges there is no score to explain; scoring says so.
    is_scored = scenario is not None and (config.missing_map == "error" or has_road_edge(scenario))
    if scenario is not None and is_scored:
        explanation = explain(scenario, read_states(entry), metric_by_name(config.metric))
        write_text(path, explanation_html(explanation))
    advance(1)
    return is_scored
