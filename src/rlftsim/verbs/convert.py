"""`rlftsim convert`: a portable data set of logged scenarios."""

from pathlib import Path
from typing import Literal

from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import Machines, usable_cores
from rlftsim.scenario.convert import convert as convert_source
from rlftsim.scenario.tfrecord import count_lost

MAX_LISTED = 20


def convert(
    source: str,
    destination: Path,
    *,
    reader: str = "auto",
    split: str | None = None,
    on_error: Literal["skip", "stop"] = "skip",
    jobs: int | None = None,
    window: Literal["last", "first", "both", "av2"] | None = None,
    keep_other: bool = False,
    sizes: Path | None = None,
    machines: Machines = Machines(),  # noqa: B008
) -> None:
    """Convert logged scenarios, such as WOMD tfrecord shards, to a portable data set.

    An interrupted conversion continues when the same command is repeated. The sources are not needed afterwards.

    Args:
        source: WOMD tfrecord shard, folder of shards, or quoted glob such as 'training/*tfrecord*'; of other sources
            a folder.
        destination: Folder of the data set.
        reader: Format of the source: womd, av2 (Argoverse 2 motion forecasting), gpudrive (JSON of GPUDrive,
            PufferDrive and Nocturne), tables (Parquet tables of your own recordings), or the name of a data source of
            another package (docs/extending.md). auto: recognized by the files.
        split: Split of all sources; left out, it is read off their folder or name.
        on_error: Fate of a damaged record: it is left out and listed, or the command stops with exit status 1.
        jobs: Processes, each with a shard of its own. Left out: one for each core.
        window: Steps of av2 only: the 91 of 110 steps that are taken, last (the default), first, or both as two
            scenarios. av2: 71 steps around the data set's own current step, which cannot be scored.
        keep_other: Keep, of av2 only, static objects, construction and the like as objects of no particular type.
        sizes: JSON file with length, width and height in meters by kind, in place of the guessed ones; av2 only.
        machines: Machines that share the work.
    """
    options = {"window": window, "keep_other": keep_other or None, "sizes": sizes}
    given = {name: value for name, value in options.items() if value is not None}
    runner = machines.runner(jobs or usable_cores(), on_error)
    report = convert_source(
        source, destination, reader=reader, split=split, on_error=on_error, jobs=jobs, runner=runner, options=given
    )
    by_split = ", ".join(f"{count} {split}" for split, count in report.counts.items())
    counts = f"{report.converted} scenarios converted, {count_lost(report.skipped)} lost"
    print_line(f"{report.destination}: {counts}; in all {by_split}.")
    for subject, count in report.tallies.items():
        print_line(f"  {count} {subject}")
    # A damaged shard can lose thousands of records: the first ones are listed.
    for record in [*report.skipped, *report.duplicates][:MAX_LISTED]:
        print_line(f"  left out: {record.file}, record {record.record}: {record.cause}")
    num_hidden = len(report.skipped) + len(report.duplicates) - MAX_LISTED
    if num_hidden > 0:
        print_line(f"  ... and {num_hidden} more")
