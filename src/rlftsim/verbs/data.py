"""`rlftsim data`: check a data set, print its statistics, or copy it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from rlftsim.errors import ConfigError
from rlftsim.jobs.buckets import is_url
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.scenario.inspect import DatasetStats, dataset_stats, verify_dataset
from rlftsim.scenario.transfer import pull_dataset, push_dataset


def verify(data: str) -> int:
    """Find damaged shards, contradictory traffic lights, teleports and missing maps.

    The exit status is 1 if a file is damaged. Doubtful contents, which are in the logs themselves, are listed.

    Args:
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
    """
    _check_local(data)
    findings = verify_dataset(dataset_folder(data))
    for finding in findings:
        print_line(finding)
    # Doubtful contents are in the logs themselves; only damage is an error.
    damaged = [finding for finding in findings if finding.problem.is_damage]
    print_line(f"{data}: {len(damaged)} damaged files, {len(findings) - len(damaged)} doubtful contents.")
    return int(bool(damaged))


def stats(data: str, *, split: str | None = None) -> None:
    """Count scenarios, agents, map points and lights.

    Args:
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        split: Split to count; left out, all of them.
    """
    _check_local(data)
    table = Table(title=data, show_header=False)
    for label, value in _stats_rows(dataset_stats(dataset_folder(data), split=split)).items():
        table.add_row(label, value)
    print_wide(table)


def push(folder: Path, url: str) -> None:
    """Copy a data set to a bucket. Readers see it when all of it is there.

    Args:
        folder: Folder of the data set.
        url: Address of the copy, such as s3://bucket/womd.
    """
    print_line(f"{url}: {push_dataset(folder, url).num_scenarios} scenarios.")


def pull(url: str, folder: Path) -> None:
    """Copy a data set from a bucket. An interrupted copy continues when the same command is repeated.

    Args:
        url: Address of the data set, such as s3://bucket/womd.
        folder: Folder of the copy.
    """
    print_line(f"{folder}: {pull_dataset(url, folder).num_scenarios} scenarios.")


def _check_local(data: str) -> None:
    """Check that a data set is no address of a bucket."""
    if is_url(data):
        raise ConfigError(f"{data}: this needs every shard: copy it with `rlftsim data pull` first.")


def _stats_rows(stats: DatasetStats) -> dict[str, str]:
    """Label -> value of a table of numbers."""
    return {
        "scenarios": f"{stats.num_scenarios} ({_counts(stats.by_split)})",
        "data sources": _counts(stats.by_source),
        "guessed in scenarios": _counts(stats.by_guessed) or "nothing",
        "logged steps": _counts(stats.by_num_steps),
        "ego does": _counts(stats.by_ego_maneuver),
        "agents at the current step": _counts(stats.agents_by_type),
        "agents a scenario": f"{stats.mean_agents:.1f}, {stats.mean_evaluated:.1f} of them evaluated",
        "map points a scenario": f"{stats.mean_map_points:.0f}",
        "with traffic lights": f"{stats.percent_with_lights:.0f} %",
        "size": f"{stats.kilobytes_per_scenario:.1f} kB a scenario",
    }


def _counts(counts: Mapping[Any, int]) -> str:
    """Numbers and their names."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())
