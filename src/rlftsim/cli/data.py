"""Verbs that make and look at data sets: convert, data, synthesize."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.table import Table
from tyro.conf import Positional

from rlftsim.errors import DataError
from rlftsim.progress import print_wide
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.inspect import DatasetStats, dataset_stats, verify_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.synthetic.generate import generate

SYNTHETIC = "synthetic"
MAX_LISTED = 20
CACHED_SCENARIOS = 1024
"""About a megabyte each; with them stay their tokens."""


def data_folder(name: str) -> Path:
    """Folder of a data set; the word "synthetic" stands for the one that ships with the package."""
    return pack_path() if name == SYNTHETIC else Path(name)


def splits_of(name: str) -> list[str]:
    """Splits that a data set has scenarios in."""
    return sorted(set(ScenarioDataset(data_folder(name)).index["split"].to_pylist()))


def open_split(name: str, split: str, *, cached: int = CACHED_SCENARIOS) -> ScenarioDataset:
    """The scenarios of a split, so many of them kept in memory.

    Raises:
        DataError: there are none; says which splits there are.
    """
    scenarios = ScenarioDataset(data_folder(name), split, cache_size=cached)
    if not len(scenarios):
        known = ", ".join(splits_of(name)) or "none at all"
        raise DataError(f"{name} has no scenarios in split {split!r}: it has {known}.")
    return scenarios


def refuse_unknown(scenarios: ScenarioDataset, scenario_id: str, name: str, place: object) -> None:
    """Refuse a scenario that a data set, or its split, does not have.

    Args:
        scenarios: those of a split, or all.
        scenario_id: what is asked for.
        name: of the data set, as it was written.
        place: what asks for it: a flag, or an entry of a file.

    Raises:
        DataError: names the split that has it, or else an id that there is.
    """
    if scenario_id in scenarios:
        return
    split = f"split {scenarios.split!r} of " if scenarios.split else ""
    known = ScenarioDataset(scenarios.folder)
    hint = f"it has {len(known)} others, such as {', '.join(known.scenario_ids[:2])}; --data names another data set."
    if scenario_id in known:
        other = known.index["split"][known.scenario_ids.index(scenario_id)]
        hint = f"it is in split {str(other)!r}, add --split {other}."
    raise DataError(f"{place}: no scenario {scenario_id} in {split}{name}: {hint}")


@dataclass(frozen=True)
class Convert:
    """Turn WOMD tfrecord shards into a portable data set.

    Interrupted in any way, the same command goes on where it was. The tfrecords are not needed afterwards.
    """

    source: Positional[str]
    """A tfrecord shard, a folder of shards, or a quoted glob such as 'training/*tfrecord*'."""
    destination: Positional[Path]
    """Folder of the data set."""
    split: str | None = None
    """Split of all sources; left out, it is read off their folder or name."""
    on_error: Literal["skip", "stop"] = "skip"
    """What to do with a damaged record: leave it out and say so, or stop."""
    jobs: int | None = None
    """Shards converted at the same time; left out, one for each core."""

    def run(self) -> int:
        """Convert and say what became of every record."""
        report = convert(self.source, self.destination, split=self.split, on_error=self.on_error, jobs=self.jobs)
        by_split = ", ".join(f"{count} {split}" for split, count in report.counts.items())
        print(
            f"{report.destination}: {report.converted} scenarios converted, {len(report.skipped)} lost; in all {by_split}."
        )
        for record in [*report.skipped, *report.duplicates][:MAX_LISTED]:
            print(f"  left out: {record.file}, record {record.record}: {record.cause}")
        hidden = len(report.skipped) + len(report.duplicates) - MAX_LISTED
        if hidden > 0:
            print(f"  ... and {hidden} more")
        return 0


@dataclass(frozen=True)
class Verify:
    """Look for damaged shards, contradictory lights, teleports and missing maps."""

    data: Positional[str]
    """Folder of a data set, or "synthetic"."""

    def run(self) -> int:
        """List what was found; exit status 1 if a file is damaged."""
        findings = verify_dataset(data_folder(self.data))
        for finding in findings:
            print(finding)
        damaged = [f for f in findings if f.problem.is_damage]
        print(f"{self.data}: {len(damaged)} damaged files, {len(findings) - len(damaged)} doubtful contents.")
        return 1 if damaged else 0


@dataclass(frozen=True)
class Stats:
    """Count scenarios, agents, lights and speeds."""

    data: Positional[str]
    """Folder of a data set, or "synthetic"."""
    split: str | None = None
    """Only this split."""

    def run(self) -> int:
        """Print the numbers."""
        print_wide(_stats_table(self.data, dataset_stats(data_folder(self.data), split=self.split)))
        return 0


def _stats_table(name: str, stats: DatasetStats) -> Table:
    table = Table(title=name, show_header=False, title_justify="left")
    rows = {
        "scenarios": f"{stats.num_scenarios} ({_counts(stats.by_split)})",
        "recorded steps": _counts(stats.by_num_steps),
        "ego does": _counts(stats.by_ego_manoeuvre),
        "agents at the current step": _counts(stats.agents_by_type),
        "agents a scenario": f"{stats.mean_agents:.1f}, {stats.mean_evaluated:.1f} of them evaluated",
        "map points a scenario": f"{stats.mean_map_points:.0f}",
        "with traffic lights": f"{stats.percent_with_lights:.0f} %",
        "size": f"{stats.kilobytes_per_scenario:.1f} kB a scenario",
    }
    rows |= {
        f"speed of {kind}s": f"mean {s.mean_mps:.1f}, 95 % below {s.p95_mps:.1f}, at most {s.max_mps:.1f} m/s"
        for kind, s in stats.speeds.items()
    }
    for label, value in rows.items():
        table.add_row(label, value)
    return table


def _counts(counts) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


@dataclass(frozen=True)
class Data:
    """Check a data set, or say what is in it."""

    action: Annotated[Verify, tyro.conf.subcommand("verify")] | Annotated[Stats, tyro.conf.subcommand("stats")]

    def run(self) -> int:
        """Run the action."""
        return self.action.run()


@dataclass(frozen=True)
class Synthesize:
    """Make synthetic scenarios with SUMO (pip install "rlftsim[synthetic]").

    The same arguments and SUMO version give the same scenarios. The pack that ships with the package was made so; its
    manifest holds the arguments.
    """

    destination: Positional[Path]
    """Folder of the data set."""
    num_scenarios: int = 200
    """In training and validation together, 4 : 1. No street network is in both."""
    seed: int = 0
    jobs: int = 1
    """Street networks made at the same time; changes no result."""

    def run(self) -> int:
        """Generate and say where."""
        manifest = generate(self.destination, num_scenarios=self.num_scenarios, seed=self.seed, jobs=self.jobs)
        print(f"{self.destination}: {sum(shard.num_rows for shard in manifest.shards)} scenarios.")
        return 0
