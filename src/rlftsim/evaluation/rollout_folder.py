"""Folder of rollouts: a file for each scenario, and a description that keeps a second model out.

An interrupted simulation goes on; files that are damaged or cut off are made again.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.evaluation.simulation import Simulation
from rlftsim.goals.placement import goals_of_batch
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import Lease, check_folder, describe_differences, find_differences, write_identity
from rlftsim.jobs.items import WholeFiles, run_items
from rlftsim.jobs.runner import Advance, Runner
from rlftsim.rollout.entries import load_entries
from rlftsim.rollout.open_world import add_visitors, check_decisions
from rlftsim.rollout.policy import get_device
from rlftsim.rollout.simulate import check_length, check_sampling, simulate
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario.batch import collate

ABOUT = "rollouts.json"
"""Model and settings of the rollouts in a folder."""


def simulate_folder(simulation: Simulation, out: Path, *, runner: Runner) -> list[Path]:
    """Simulate the scenarios that have no complete file yet; returns the files of all.

    Args:
        simulation: Policy, scenarios and settings, which must be those of the rollouts that are in the folder.
        out: Folder of the files `<scenario id>.npz` and of the description, made if missing.
        runner: Runner of the work; changes no result.

    Raises:
        ConfigError: A folder of rollouts of a second model or other settings, or a policy that cannot sample so.
        DataError: A damaged description, or a folder of a different type of result.
        NotYetError: A second driver at work in the folder.
        SetAside, Unfinished: See `run_items`.
    """
    check_length(simulation.policy, simulation.num_steps)
    if load_entries(simulation.entries) is not None:  # what cannot be read is refused before the folder is touched
        check_decisions(simulation.policy.steps_per_decision)
    check_sampling(simulation.policy, simulation.dataset, simulation.sampling)
    identity = simulation.describe()
    rollouts = WholeFiles[str](out, "{}.npz".format, partial(_validate_file, simulation))
    check_folder(out, "set of rollouts")
    _check_identity(out, identity)  # before the folder gets a lock file
    with Lease(out / ".lock", runner, "works in") as lease:
        _check_identity(out, identity, is_alone=lease.is_alone)
        write_identity(out / ABOUT, identity)
        _check_identity(out, identity, is_alone=lease.is_alone)  # another share may have begun at the same moment
        task = partial(_simulate_scenario, simulation, out)
        paths = run_items("simulate", simulation.scenario_ids, task, format=rollouts, lease=lease)
        remove_temporaries([out / ABOUT, *paths])  # of processes that were killed
        lease.remove()
    return paths


def _validate_file(simulation: Simulation, path: Path) -> Path:
    """The file of a scenario; checksums, types and shapes of its arrays are right.

    Raises:
        DataError: Damaged file, or other rollouts than those of the scenario that the file is named after.
    """
    entries = [entry for entry in find_rollouts(path) if entry.scenario_id == path.stem]
    shapes = [read_states(entry, None).x.shape[::2] for entry in entries]  # (N, T)
    if shapes != [(simulation.num_rollouts, simulation.num_steps)]:
        raise DataError(f"{path}: it holds other rollouts than {simulation.num_rollouts} of its scenario.")
    return path


def _simulate_scenario(
    simulation: Simulation, out: Path, scenario_id: str, advance: Advance, is_stopped: Callable[[], bool]
) -> Path | None:
    """File with the rollouts of a scenario, written now; None where the work is being stopped."""
    if is_stopped():
        return None
    scenario, entries = simulation.dataset.by_id(scenario_id), load_entries(simulation.entries)
    batch = collate([scenario if entries is None else add_visitors(scenario)]).to(get_device(simulation.policy))
    goal_entries = simulation.goals.of_scenario(scenario_id)
    rollouts = simulate(
        simulation.policy, batch, num_rollouts=simulation.num_rollouts, seed=simulation.seed,
        num_steps=simulation.num_steps, sampling=simulation.sampling,
        goals=goals_of_batch(goal_entries, batch) if goal_entries else None, entries=entries,
    )  # fmt: skip
    [path] = write_rollouts(out, batch, rollouts)
    advance(1)
    return path


def _check_identity(folder: Path, identity: Mapping[str, Any], *, is_alone: bool = True) -> None:
    """Check that a folder holds only the rollouts of a description.

    Args:
        folder: Folder of the rollouts; may be missing.
        identity: Description of the work, by the names of its settings.
        is_alone: False where other shares may be at work, with a description and no rollouts yet.

    Raises:
        ConfigError: Rollouts of a second model or other settings, or a share that makes such rollouts.
        DataError: A damaged description.
    """
    path = folder / ABOUT
    rollouts = sorted(folder.glob("*.npz"))
    way_out = "name another --out"
    if rollouts and not path.exists():
        raise ConfigError(f"{folder} holds {rollouts[0].name} but no {ABOUT}, so their model is unknown: {way_out}.")
    differences = find_differences(path, identity, way_out)
    model = differences.pop("model", identity["model"])
    if differences and (rollouts or not is_alone):
        begun = "holds" if rollouts else "was begun by a share for"
        described = describe_differences(differences, identity)
        raise ConfigError(f"{folder} {begun} rollouts of {model} with another {described}: {way_out}.")
