"""Verbs that make and inspect data sets: convert, data, synthesize."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.table import Table
from tyro.conf import Positional

from rlftsim.errors import ConfigError
from rlftsim.jobs.buckets import is_url
from rlftsim.jobs.progress import print_wide
from rlftsim.jobs.runner import Machines, Work, usable_cores
from rlftsim.scenario.convert import convert
from rlftsim.scenario.inspect import DatasetStats, dataset_stats, verify_dataset
from rlftsim.scenario.open import dataset_folder
from rlftsim.scenario.synthetic.generate import generate
from rlftsim.scenario.tfrecord import count_lost
from rlftsim.scenario.transfer import pull_dataset, push_dataset

MAX_LISTED = 20


@dataclass(frozen=True)
class Convert:
    """Convert logged scenarios, such as WOMD tfrecord shards, to a portable data set.

    An interrupted conversion continues when the same command is repeated. The sources are not needed afterwards.
    """

    source: Annotated[Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """For WOMD a tfrecord shard, a folder of shards, or a quoted glob such as 'training/*tfrecord*'. For other
    sources a folder."""
    destination: Annotated[Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder of the data set."""
    reader: Annotated[str, tyro.conf.arg(name="from", metavar="NAME")] = "auto"
    """Format of the source: womd, av2 (Argoverse 2 motion forecasting), tables (Parquet tables of your own
    recordings), or the name of a data source of another package (docs/extending.md). auto: recognized by the files."""
    split: str | None = None
    """Split of all sources; left out, it is read off their folder or name."""
    on_error: Literal["skip", "stop"] = "skip"
    """A damaged record is left out and listed, or the command stops with exit status 1."""
    jobs: int | None = None
    """Processes, each with a shard of its own. Left out: one for each core."""
    window: Literal["last", "first", "both", "av2"] | None = None
    """av2 only: the 91 of 110 steps that are taken, last (the default), first, or both as two scenarios. av2: 71
    steps around the data set's own current step, which cannot be scored."""
    keep_other: bool = False
    """av2 only: keep static objects, construction and the like as objects of no particular type."""
    sizes: Path | None = None
    """av2 only: JSON file with length, width and height in meters by kind, in place of the guessed ones."""
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)

    def run(self) -> int:
        """Convert, and list the records that were left out."""
        options = {"window": self.window, "keep_other": self.keep_other or None, "sizes": self.sizes}
        report = convert(
            self.source,
            self.destination,
            reader=self.reader,
            split=self.split,
            on_error=self.on_error,
            jobs=self.jobs,
            runner=self.machines.runner(self.jobs or usable_cores(), self.on_error),
            options={name: value for name, value in options.items() if value is not None},
        )
        by_split = ", ".join(f"{count} {split}" for split, count in report.counts.items())
        counts = f"{report.converted} scenarios converted, {count_lost(report.skipped)} lost"
        print(f"{report.destination}: {counts}; in all {by_split}.")
        for what, count in report.tallies.items():
            print(f"  {count} {what}")
        # A damaged shard can lose thousands of records: the first ones are listed.
        for record in [*report.skipped, *report.duplicates][:MAX_LISTED]:
            print(f"  left out: {record.file}, record {record.record}: {record.cause}")
        hidden = len(report.skipped) + len(report.duplicates) - MAX_LISTED
        if hidden > 0:
            print(f"  ... and {hidden} more")
        return 0


@dataclass(frozen=True)
class Verify:
    """Find damaged shards, contradictory traffic lights, teleports and missing maps."""

    data: Annotated[Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""

    def run(self) -> int:
        """List the findings; exit status 1 if a file is damaged."""
        _refuse_remote(self.data)
        findings = verify_dataset(dataset_folder(self.data))
        for finding in findings:
            print(finding)
        # Doubtful contents are in the logs themselves; only damage is an error.
        damaged = [f for f in findings if f.problem.is_damage]
        print(f"{self.data}: {len(damaged)} damaged files, {len(findings) - len(damaged)} doubtful contents.")
        return 1 if damaged else 0


def _refuse_remote(data: str) -> None:
    if is_url(data):
        raise ConfigError(f"{data}: this reads every shard: copy it with `rlftsim data pull` first.")


@dataclass(frozen=True)
class Stats:
    """Count scenarios, agents, lights and speeds."""

    data: Annotated[Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    split: str | None = None
    """Only this split."""

    def run(self) -> int:
        """Print the numbers."""
        _refuse_remote(self.data)
        stats = dataset_stats(dataset_folder(self.data), split=self.split)
        table = Table(title=self.data, show_header=False, title_justify="left")
        for label, value in _stats_rows(stats).items():
            table.add_row(label, value)
        print_wide(table)
        return 0


@dataclass(frozen=True)
class Push:
    """Copy a data set to a bucket. Readers see it when all of it is there."""

    folder: Annotated[Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder of the data set."""
    url: Annotated[Positional[str], tyro.conf.arg(metavar="URL")]
    """Address of the copy, such as s3://bucket/womd."""

    def run(self) -> int:
        """Copy."""
        print(f"{self.url}: {push_dataset(self.folder, self.url).num_scenarios} scenarios.")
        return 0


@dataclass(frozen=True)
class Pull:
    """Copy a data set from a bucket. An interrupted copy continues when the same command is repeated."""

    url: Annotated[Positional[str], tyro.conf.arg(metavar="URL")]
    """Address of the data set, such as s3://bucket/womd."""
    folder: Annotated[Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder of the copy."""

    def run(self) -> int:
        """Copy."""
        print(f"{self.folder}: {pull_dataset(self.url, self.folder).num_scenarios} scenarios.")
        return 0


def _stats_rows(stats: DatasetStats) -> dict[str, str]:
    """Label -> value of a table of numbers."""
    rows = {
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
    return rows | {
        f"speed of {kind}s": f"mean {s.mean_mps:.1f}, 95 % below {s.p95_mps:.1f}, at most {s.max_mps:.1f} m/s"
        for kind, s in stats.speeds.items()
    }


def _counts(counts) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


@dataclass(frozen=True)
class Data:
    """Check a data set for damage, print its statistics, or copy it to a bucket and back."""

    action: (
        Annotated[Verify, tyro.conf.subcommand("verify")]
        | Annotated[Stats, tyro.conf.subcommand("stats")]
        | Annotated[Push, tyro.conf.subcommand("push")]
        | Annotated[Pull, tyro.conf.subcommand("pull")]
    )

    def run(self) -> int:
        """Run the action."""
        return self.action.run()


@dataclass(frozen=True)
class Synthesize:
    """Make synthetic scenarios with SUMO (pip install "rlftsim[synthetic]").

    The same arguments and SUMO version give the same scenarios. The pack that ships with the package was made
    this way; its manifest holds the arguments.
    """

    destination: Annotated[Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder of the data set."""
    num_scenarios: int = 200
    """Scenarios in training and validation together, 4 : 1. No street network is in both."""
    seed: int = 0
    """Seed of streets and traffic."""
    jobs: int = 1
    """Processes, each with a street network of its own. Changes no result."""
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Generate the scenarios."""
        manifest = generate(
            self.destination,
            num_scenarios=self.num_scenarios,
            seed=self.seed,
            jobs=self.jobs,
            runner=self.work.runner(self.jobs, self.work.on_error),
        )
        print(f"{self.destination}: {sum(shard.num_rows for shard in manifest.shards)} scenarios.")
        return 0
