"""`rs.simulate` and `rlftsim simulate`: futures of scenarios, in memory or in files."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, overload

import torch
import tyro

from rlftsim.errors import ConfigError, DataError, whole_number
from rlftsim.evaluation.evaluate import check_jobs, frozen_copy
from rlftsim.evaluation.exporters import exporter_by_name
from rlftsim.evaluation.rollout_folder import Simulation, simulate_folder
from rlftsim.goals.maneuvers.lane_paths import HORIZON_S
from rlftsim.goals.placement import FASTEST_MPS
from rlftsim.goals.types import Goals
from rlftsim.jobs.progress import log, print_line, progress_bar
from rlftsim.jobs.runner import Work, choose_runner
from rlftsim.policies.registry import with_guidance
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling, get_device, is_goal_conditioned, is_training
from rlftsim.rollout.simulate import check_sampling
from rlftsim.rollout.simulate import simulate as simulate_batch
from rlftsim.rollout.types import RolloutProvenance, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import check_membership, open_dataset, to_scenarios
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.verbs.arguments import Data, Device, File, GoalPoints, Model
from rlftsim.verbs.goal_outcomes import read_rollouts, report_outcomes
from rlftsim.verbs.goals import read_given_goals, warn_of_doubts
from rlftsim.verbs.inputs import to_batch, to_policy, to_sampling


@overload
def simulate(
    policy: Model, scenarios: Data, *, num_rollouts: int = ..., seed: int = ..., goals: GoalPoints | None = ...,
    sampling: Sampling | None = ..., out: None = ..., split: str = ..., guidance_scale: float = ...,
    device: Device = ...,
) -> Rollouts: ...  # fmt: skip
@overload
def simulate(
    policy: Model, scenarios: Data, *, num_rollouts: int = ..., seed: int = ..., goals: GoalPoints | None = ...,
    sampling: Sampling | None = ..., out: File, split: str = ..., scenario: list[str] | None = ...,
    limit: int | None = ..., goal: tuple[str, ...] = ..., guidance_scale: float = ..., picture: bool = ...,
    export: tuple[str, ...] = ..., device: Device = ..., jobs: int = ..., work: Work = ...,
) -> list[Path]: ...  # fmt: skip
def simulate(
    policy: Model,
    scenarios: Data,
    *,
    num_rollouts: int = 32,
    seed: int = 0,
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
    """Simulate futures of scenarios: the model moves every agent, the ego included, for 8 seconds.

    The same seed gives the same rollouts in Python and on the command line, whatever other scenarios are simulated
    with one.

    Writes one npz file per scenario: scenario_id, object_ids [A], x y z heading [N, A, 80], world frame. Existing files
    are kept, so an interrupted simulation continues when the same command is repeated; one that is damaged or cut off
    is simulated again. In Python, without a folder, the rollouts are returned.

    Args:
        policy: Run, model folder, or registered name such as "constant_velocity". In Python also a policy, which
            is simulated as in evaluation mode.
        scenarios: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also an
            opened data set, and, for rollouts in memory, one scenario, several or a batch. Only history, map and lights
            are used.
        num_rollouts: Number N of rollouts of each scenario.
        seed: Seed of the rollouts. The same seed gives the same rollouts.
        goals: Goals file (docs/goals.md). Without --scenario only its scenarios are simulated. In Python, for rollouts
            in memory, points in meters in the world frame, {object_id: (x, y)} or {scenario_id: {object_id: (x, y)}},
            or goals of the whole batch as tensors.
        sampling: Temperature and truncation of the decisions; left out, the whole distribution is sampled.
        out: Folder for the rollouts. Left out in Python, all are in memory at once.
        split: Split of the data set.
        scenario: Ids of the scenarios to simulate; left out, all of them.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        goal: AGENT=X,Y is the goal of an agent of the one --scenario, in meters in the world frame of the log. May be
            given many times.
        guidance_scale: Factor on the goal-progress bias of the model's logits: above 1 it follows goals more closely
            than it learned to.
        picture: Draw OUT/SCENARIO.png: simulated paths of the agents with goals, or else of the evaluated agents.
        export: Write further files of each scenario: "page" is OUT/SCENARIO.html, which plays in any browser, "film" is
            OUT/SCENARIO.mp4; other names are those of installed plug-ins.
        device: Device of a model that is loaded; auto: the GPU if torch has one; several processes (--jobs) need cpu.
        jobs: Processes, each with one thread. Changes no result.
        work: Machines that share the work.

    Returns:
        Rollouts with padding up to the scenario with the most agents, which know their scenarios and seed
        (`provenance`); `trajectory(object_id)` gives an agent's poses in the world frame. With a folder the paths of
        the files.

    Raises:
        ConfigError: No scenario, fewer than one rollout, goals for a policy that is not goal-conditioned, for
            scenarios that were not handed over or in another frame, or a folder of other rollouts.
        DataError: An unknown scenario, or a goal of an agent that is not simulated, out of its reach, or not two finite
            numbers.
    """
    num_rollouts, seed = whole_number("num_rollouts", num_rollouts, 1), whole_number("seed", seed)
    limit = None if limit is None else whole_number("limit", limit, 1)
    sampling = to_sampling(sampling)
    if out is not None:
        return _simulate_files(
            policy, scenarios, Path(out), num_rollouts, seed, sampling,
            goals=goals, split=split, scenario=scenario, limit=limit, goal=goal, guidance_scale=guidance_scale,
            picture=picture, export=export, device=device, jobs=jobs, work=work,
        )  # fmt: skip
    options = {"scenario": scenario, "limit": limit, "goal": goal, "picture": picture, "export": export}
    for name, value in options.items():
        if value not in (None, (), False):
            raise ConfigError(f"{name} has no effect on rollouts in memory: leave it out, or name a folder as out.")
    model = with_guidance(_to_evaluated(to_policy(policy, device)), guidance_scale)
    if isinstance(scenarios, str | PathLike):
        scenarios = to_scenarios(scenarios, split)
    return _simulate_in_memory(model, to_batch(scenarios, get_device(model)), num_rollouts, seed, sampling, goals)


def _to_evaluated(model: Policy) -> Policy:
    """A copy in evaluation mode of a model in training mode: with dropout a seed would not say what happens."""
    return frozen_copy(model) if is_training(model) else model


def _simulate_in_memory(
    model: Policy, batch: ScenarioBatch, num_rollouts: int, seed: int, sampling: Sampling, goals: Any
) -> Rollouts:
    """Rollouts of a batch, one scenario after another; arguments as in `simulate`."""
    if not isinstance(goals, Goals | Mapping | None):
        raise ConfigError(
            f"goals must be {{object_id: (x, y)}}, {{scenario_id: {{object_id: (x, y)}}}} or Goals, got {goals!r}."
        )
    placed = goals.to(batch.device) if isinstance(goals, Goals) else Goals.from_points(batch, goals or {})
    if placed.frame != batch.frame:
        raise ConfigError(
            f"goals in the {placed.frame} frame do not fit scenarios in the {batch.frame} frame: make them with "
            "rs.Goals.from_points(batch, points) and simulate the same batch, or give {object_id: (x, y)}."
        )
    num_scenarios, rollouts_with_goals, num_agents = placed.goal_mask.shape
    if (num_scenarios, num_agents) != tuple(batch.agent_mask.shape):
        raise ConfigError(
            f"goals of {num_scenarios} scenarios × {num_agents} agents do not belong to {batch.num_scenarios} × "
            f"{batch.agent_mask.shape[1]}: hand over goals of the same scenarios."
        )
    if rollouts_with_goals not in (1, num_rollouts):
        raise ConfigError(
            f"goals of {rollouts_with_goals} rollouts do not fit num_rollouts={num_rollouts}: give goals of one "
            "rollout or of as many."
        )
    has_goals = placed.goal_mask.any(-1).any(-1).tolist()  # [B]
    if any(has_goals):  # else there may be no agent at all
        _check_reach(placed, batch)
        if not is_goal_conditioned(model):
            raise ConfigError(
                f"goals have no effect: {type(model).__name__} is not goal-conditioned: load a model that was "
                "fine-tuned with goals, or leave goals out."
            )
    # One scenario at a time, as the command line does: memory does not grow with the number of scenarios that are in
    # the loop, and no result depends on the company of a scenario.
    simulated = []
    with progress_bar("simulate", batch.num_scenarios, show=batch.num_scenarios > 1) as advance:
        for row, scenario_batch in enumerate(batch.split(1)):
            scenario_goals = None
            if has_goals[row]:
                rows = slice(row, row + 1)
                scenario_goals = replace(placed, position=placed.position[rows], goal_mask=placed.goal_mask[rows])
            simulated.append(
                simulate_batch(
                    model, scenario_batch, num_rollouts=num_rollouts, seed=seed, goals=scenario_goals,
                    sampling=sampling,
                )
            )  # fmt: skip
            advance()
    # All batches of one scenario are padded alike (`split`), so they can be joined along axis B.
    provenance = RolloutProvenance(
        scenarios=batch.scenarios,
        frame=batch.frame,
        policy=type(model).__name__,
        policy_fingerprint=fingerprint_policy(model),
        seed=seed,
        temperature=sampling.temperature,
        top_k=sampling.top_k,
    )
    tensors = ("position", "heading", "decision", "decision_mask", "log_prob")
    if simulated[0].draws is not None:
        tensors = (*tensors, "draws")
    joined = {name: torch.cat([getattr(rollouts, name) for rollouts in simulated]) for name in tensors}
    all_goals = placed.repeat(num_rollouts) if any(has_goals) else None
    return replace(simulated[0], **joined, goals=all_goals, provenance=provenance)


def _simulate_files(
    model: Model,
    data: Data,
    out: Path,
    num_rollouts: int,
    seed: int,
    sampling: Sampling,
    *,
    goals: Any,
    split: str,
    scenario: list[str] | None,
    limit: int | None,
    goal: tuple[str, ...],
    guidance_scale: float,
    picture: bool,
    export: tuple[str, ...],
    device: Device,
    jobs: int,
    work: Work,
) -> list[Path]:
    """Write rollouts that have no file yet, report goals, and draw; arguments as in `simulate`."""
    # 1. model, data and goals; anything that does not fit is refused before the folder is touched
    exporters = [exporter_by_name(name) for name in export]
    policy = with_guidance(_to_evaluated(to_policy(model, device)), guidance_scale)
    check_jobs(jobs, get_device(policy), "jobs")
    if not isinstance(data, str | PathLike | ScenarioDataset) or not isinstance(goals, str | PathLike | None):
        raise ConfigError("rollouts in a folder need a data set, and goals in a file: give these, or no folder.")
    scenarios = data if isinstance(data, ScenarioDataset) else open_dataset(data, split)
    name = str(scenarios.folder if isinstance(data, ScenarioDataset) else data)
    file = read_given_goals(None if goals is None else Path(goals), list(goal), scenario)
    if file.goals and not is_goal_conditioned(policy):
        raise ConfigError(
            f"{model} is not goal-conditioned, {len(file.goals)} goals would have no effect: take a model "
            "that was fine-tuned with goals (docs/goals.md), or leave --goal and --goals out."
        )
    if guidance_scale != 1.0 and not file.goals:
        raise ConfigError(f"--guidance-scale {guidance_scale:g} has no effect without goals: add --goal or --goals.")
    ids = list(dict.fromkeys(scenario or file.scenario_ids or scenarios.scenario_ids))[:limit]
    for scenario_id in ids:
        entries = file.of_scenario(scenario_id)
        check_membership(scenarios, scenario_id, name, "--scenario" if scenario else next(iter(entries), ""))
        if entries:
            warn_of_doubts(entries, scenarios.by_id(scenario_id))
        elif file.goals:
            log.info(f"  scenario {scenario_id} has no goals: it is simulated without.")
    check_sampling(policy, scenarios, sampling)
    # 2. simulate what is missing; a folder of other rollouts is refused
    simulation = Simulation(policy, scenarios, num_rollouts, seed, sampling, file)
    runner = work.runner(jobs, work.on_error) or choose_runner(jobs, len(ids))
    paths = simulate_folder(
        simulation,
        ids,
        out,
        model=str(model) if isinstance(model, str | PathLike) else type(model).__name__,
        runner=runner,
    )
    # 3. outcomes of goals, also of rollouts that an earlier call has written
    reported = [scenarios.by_id(scenario_id) for scenario_id in ids if file.of_scenario(scenario_id) or picture]
    report_outcomes(out, reported, file, picture=picture)
    # 4. further files, likewise
    for exported in map(scenarios.by_id, ids if exporters else ()):
        states = read_rollouts(out, exported)
        for write in exporters:
            print_line(write(exported, states, out))
    return paths


def print_rollouts(paths: list[Path], *, out: Path, num_rollouts: int) -> None:
    """Print what the folder holds.

    Args:
        paths: Files of the scenarios.
        out: Folder of the rollouts, see `simulate`.
        num_rollouts: Number of rollouts of each scenario.
    """
    print(f"{out}: {num_rollouts} rollouts of {len(paths)} scenarios.")


def _check_reach(goals: Goals, batch: ScenarioBatch) -> None:
    """Refuse goals that nothing reaches in 8 seconds: mostly points of another frame.

    Raises:
        DataError: Such a goal; names the agent.
    """
    offset = goals.position - batch.position[:, None, :, CURRENT_STEP]  # [B, N, A, 2]
    distance = torch.where(goals.goal_mask, offset.norm(dim=-1), 0.0).amax(1)  # [B, A]
    row, agent = divmod(int(distance.argmax()), distance.shape[1])
    distance_m = float(distance[row, agent])
    if distance_m > FASTEST_MPS * HORIZON_S:
        raise DataError(
            f"goal of agent {int(batch.object_id[row, agent])} in scenario {batch.scenarios[row].scenario_id} is "
            f"{distance_m:.0f} m away, out of reach in {HORIZON_S:g} s: x and y are meters in the world frame of the "
            "log."
        )
