"""`rs.simulate` and `rlftsim simulate`: futures of scenarios, in memory or in files."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, overload

import tyro

from rlftsim.errors import ConfigError, whole_number
from rlftsim.evaluation.exporters import exporter_by_name, report_rollouts
from rlftsim.evaluation.in_memory import simulate_in_memory
from rlftsim.evaluation.rollout_folder import simulate_folder
from rlftsim.evaluation.simulation import Simulation
from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import Work, check_jobs, choose_runner
from rlftsim.policies.registry import with_guidance
from rlftsim.rollout.policy import Sampling, frozen_copy, get_device, is_training
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import count_steps
from rlftsim.verbs.arguments import Data, Device, File, GoalPoints, Model
from rlftsim.verbs.goals import check_goal_effects, check_scenarios, read_given_goals
from rlftsim.verbs.inputs import (
    check_left_out,
    check_sampling,
    to_batch,
    to_dataset,
    to_policy,
    to_sampling,
    with_checked_arguments,
)

IN_FILES = ("scenario", "limit", "goal", "picture", "export", "jobs", "work")
"""Arguments without effect on rollouts in memory."""


@overload
def simulate(
    policy: Model, scenarios: Data, *, num_rollouts: int = ..., seed: int = ..., seconds: float = ...,
    entries: str | None = ..., goals: GoalPoints | None = ..., sampling: Sampling | None = ..., out: None = ...,
    split: str = ..., guidance_scale: float = ..., device: Device = ...,
) -> Rollouts: ...  # fmt: skip
@overload
def simulate(
    policy: Model, scenarios: Data, *, num_rollouts: int = ..., seed: int = ..., seconds: float = ...,
    entries: str | None = ..., goals: GoalPoints | None = ..., sampling: Sampling | None = ..., out: File,
    split: str = ..., scenario: list[str] | None = ..., limit: int | None = ..., goal: tuple[str, ...] = ...,
    guidance_scale: float = ..., picture: bool = ..., export: tuple[str, ...] = ..., device: Device = ...,
    jobs: int = ..., work: Work = ...,
) -> list[Path]: ...  # fmt: skip
@with_checked_arguments
def simulate(
    policy: Model,
    scenarios: Data,
    *,
    num_rollouts: int = 32,
    seed: int = 0,
    seconds: float = 8.0,
    entries: str | None = None,
    goals: GoalPoints | None = None,
    sampling: Sampling | None = None,
    out: File | None = None,
    split: str = "validation",
    scenario: list[str] | None = None,
    limit: int | None = None,
    goal: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    guidance_scale: float = 1.0,
    picture: bool = False,
    export: tuple[str, ...] = (),
    device: Device = "auto",
    jobs: int = 1,
    work: Work = Work(),  # noqa: B008
) -> Rollouts | list[Path]:
    """Simulate futures of scenarios: the model moves every agent, the ego included.

    Writes one npz file per scenario: scenario_id, object_ids [A], x y z heading [N, A, T], world frame. Existing files
    are kept, so an interrupted simulation continues when the same command is repeated; one that is damaged or cut off
    is simulated again. In Python, without a folder, the rollouts are returned.

    Args:
        policy: Run, model folder, or registered name such as "constant_velocity". In Python also a policy, which
            is simulated as in evaluation mode.
        scenarios: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also an
            opened data set, and, for rollouts in memory, one scenario, several or a batch. Only history, map and lights
            are used.
        num_rollouts: Number N of rollouts of each scenario.
        seed: Seed of the rollouts. The same gives the same rollouts in Python and here, in any company of scenarios.
        seconds: Length of the rollouts. Scores, goals and submissions need the 8 of the metric; a longer rollout
            begins with the same states as one of 8 s.
        entries: Who enters where lanes cross the border of a region around the ego: "fitted", "fixed-rate", "none",
            a file that `rlftsim entries fit` wrote, or a name of an installed plug-in. Agents beyond the border leave.
            Left out, the agents of "now" are there all the time.
        goals: Goals file (docs/goals.md). Without --scenario only its scenarios are simulated. In Python, for rollouts
            in memory, points in meters in the world frame, {object_id: (x, y)} or {scenario_id: {object_id: (x, y)}},
            or goals of the whole batch as tensors.
        sampling: Temperature and truncation of the decisions; left out, the whole distribution is sampled.
        out: Folder for the rollouts. Left out in Python, all are in memory at once.
        split: Split of the data set.
        scenario: Ids of the scenarios to simulate; left out, all of them.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        goal: AGENT=X,Y, goal of an agent of the one --scenario, m in the world frame of the log. May be repeated.
        guidance_scale: Factor on the goal-progress bias of the logits: above 1 follows goals more than was learned.
        picture: Draw OUT/SCENARIO.png: simulated paths of the agents with goals, or else of the evaluated agents.
        export: Write further files of each scenario: "page" is OUT/SCENARIO.html, which plays in any browser, "film" is
            OUT/SCENARIO.mp4, "gpudrive" a JSON file for each rollout, "rerun" one for the Rerun viewer; other names
            are those of installed plug-ins.
        device: Device of a model that is loaded; auto: the GPU if torch has one; several processes (--jobs) need cpu.
        jobs: Processes, each with one thread. Changes no result.
        work: Machines that share the work.

    Returns:
        Rollouts with padding up to the scenario with the most agents, which know their scenarios and seed
        (`provenance`); `trajectory(object_id)` gives an agent's poses in the world frame. With a folder the paths of
        the files.

    Raises:
        ConfigError: No scenario, fewer than one rollout, a length that the model's decisions do not divide, goals for a
            policy that is not goal-conditioned or for another length than 8 s, for scenarios that were not handed over
            or in another frame, or a folder of other rollouts.
        DataError: An unknown scenario, or a goal of an agent that is not simulated, out of its reach, or not two finite
            numbers.
    """
    num_rollouts, seed = whole_number("num_rollouts", num_rollouts, 1), whole_number("seed", seed, 0)
    num_steps, entries = count_steps(seconds), None if entries is None else str(entries)
    limit, sampling = None if limit is None else whole_number("limit", limit, 1), to_sampling(sampling)
    if out is None:
        _check_in_memory(locals())
    # anything that does not fit is refused before a folder is touched
    exporters = [exporter_by_name(name) for name in export]
    loaded = to_policy(policy, device)
    # with dropout a seed would not say what happens
    model = with_guidance(frozen_copy(loaded) if is_training(loaded) else loaded, guidance_scale)
    check_sampling(model, sampling)
    if out is None:
        batch = to_batch(scenarios, get_device(model), split)
        return simulate_in_memory(model, batch, num_rollouts, seed, num_steps, sampling, goals, entries)
    check_jobs(jobs, get_device(model), "jobs")
    dataset = to_dataset(scenarios, split)
    if dataset is None or not isinstance(goals, str | PathLike | None):
        raise ConfigError("rollouts in a folder need a data set, and goals in a file: give these, or no folder.")
    name = str(policy) if isinstance(policy, str | PathLike) else type(policy).__name__
    file = read_given_goals(None if goals is None else Path(goals), list(goal), scenario)
    check_goal_effects(file, model, name, guidance_scale)
    ids = list(dict.fromkeys(scenario or file.scenario_ids or dataset.scenario_ids))[:limit]
    check_scenarios(ids, file, dataset, str(dataset.folder if scenarios is dataset else scenarios), bool(scenario))
    runner = work.runner(jobs, work.on_error) or choose_runner(jobs, len(ids))
    simulation = Simulation(model, dataset, tuple(ids), num_rollouts, num_steps, seed, sampling, file, name, entries)
    paths = simulate_folder(simulation, Path(out), runner=runner)
    # also of rollouts that an earlier call has written
    report_rollouts(Path(out), dataset, ids, file, picture=picture, exporters=exporters)
    return paths


def _check_in_memory(values: Mapping[str, Any]) -> None:
    """Check that no argument is given that has no effect on rollouts in memory.

    Raises:
        ConfigError: An argument for rollouts in files, or a guidance scale without goals.
    """
    way_out = "leave it out, or name a folder as out"
    check_left_out(simulate, values, IN_FILES, f"has no effect on rollouts in memory: {way_out}.")
    scale, goals = values["guidance_scale"], values["goals"]
    if scale != 1.0 and isinstance(goals, Mapping | None) and not goals:
        raise ConfigError(f"guidance_scale={scale:g} has no effect without goals: add goals.")


def print_rollouts(paths: list[Path], *, out: Path, num_rollouts: int) -> None:
    """Print what the folder holds.

    Args:
        paths: Files of the scenarios.
        out: Folder of the rollouts, see `simulate`.
        num_rollouts: Number of rollouts of each scenario.
    """
    print_line(f"{out}: {num_rollouts} rollouts of {len(paths)} scenarios.")
