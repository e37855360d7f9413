"""`rlftsim export`: stored rollouts in files of other programs."""

from os import PathLike
from pathlib import Path
from typing import cast

from rlftsim.evaluation.exporters import exporter_by_name, read_rollouts, with_entrants
from rlftsim.evaluation.rollout_files import find_rollouts
from rlftsim.evaluation.scenario_source import open_scenarios
from rlftsim.jobs.files import errors_name
from rlftsim.jobs.progress import print_line
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.verbs.arguments import Name


def export(exporter: str, rollouts: Path, out: Path, *, scenarios: Name) -> None:
    """Write stored rollouts as files that other programs read.

    Args:
        exporter: "gpudrive" writes a JSON file for each rollout, which GPUDrive and PufferDrive read, "rerun" one
            for the Rerun viewer, "page" a page that plays in any browser, "film" an mp4; other names are those of
            installed plug-ins.
        rollouts: File of rollouts, or folder of them, as of `rlftsim simulate`.
        out: Folder for the files; those of the same names are replaced.
        scenarios: Simulated scenarios: a converted data set, tfrecords (file, folder, quoted glob), or "synthetic".

    Raises:
        ConfigError: No such exporter.
        DataError: Rollouts of an unknown scenario, damaged ones, or those of other agents.
    """
    write, entries = exporter_by_name(exporter), find_rollouts(rollouts)
    source = open_scenarios(dataset_folder(cast("str | PathLike[str]", scenarios)))
    with errors_name(out):
        out.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        scenario = source.by_id(entry.scenario_id)
        states = read_rollouts(entry, scenario)
        print_line(write(with_entrants(scenario, states), states, out))
