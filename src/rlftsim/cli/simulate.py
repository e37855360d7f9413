"""The verb that rolls out scenarios: simulate."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import check_jobs
from rlftsim.evaluation.exporters import exporter_by_name
from rlftsim.evaluation.rollout_folder import Simulation, simulate_folder
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import Work, choose_runner
from rlftsim.policies.registry import Device, load_policy, with_guidance
from rlftsim.rollout.policy import Sampling, get_device, is_goal_conditioned
from rlftsim.rollout.simulate import check_sampling
from rlftsim.scenario.open import check_splits, open_dataset
from rlftsim.verbs.goal_outcomes import read_rollouts, report_outcomes
from rlftsim.verbs.goals import read_given_goals, warn_of_doubts


@dataclass(frozen=True)
class Simulate:
    """Simulate futures of scenarios: the model moves every agent, the ego included, for 8 seconds.

    Writes one npz file per scenario: scenario_id, object_ids [A], x y z heading [N, A, 80], world frame.
    Existing files are kept, so an interrupted simulation continues when the same command is repeated; one that is
    damaged or cut off is simulated again.
    """

    model: Annotated[Positional[str], tyro.conf.arg(metavar="MODEL")]
    """A run, a model folder, or a registered name such as "constant_velocity"."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder for the rollouts."""
    split: str = "validation"
    """Split of the data set."""
    scenario: list[str] | None = None
    """Simulate only the scenarios with these ids."""
    limit: int | None = None
    """Only the first so many scenarios."""
    num_rollouts: int = 32
    """Rollouts of each scenario."""
    seed: int = 0
    """Seed of the rollouts. The same seed gives the same rollouts."""
    temperature: float = 1.0
    """Sampling temperature: below 1 likely motions become more likely; 0 always takes the most likely one,
    of continuous actions the mean."""
    top_k: int | None = None
    """Sample among the TOP_K most likely motions only."""
    goal: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """AGENT=X,Y is the goal of an agent of the one --scenario, in meters in the world frame of the log. May be
    given many times."""
    goals: Path | None = None
    """Goals file (docs/goals.md). Without --scenario only its scenarios are simulated."""
    guidance_scale: float = 1.0
    """Factor on the goal-progress bias of the model's logits: above 1 it follows goals more closely than it
    learned to."""
    picture: bool = False
    """Draw OUT/SCENARIO.png: simulated paths of the agents with goals, or else of the evaluated agents."""
    export: list[str] = field(default_factory=list)
    """Write further files of each scenario: "page" is OUT/SCENARIO.html, which plays in any browser, "film" is
    OUT/SCENARIO.mp4; other names are those of installed plug-ins."""
    device: Device = "auto"
    """auto: the GPU if torch has one; several processes (--jobs) need cpu."""
    jobs: int = 1
    """Processes, each with one thread. Changes no result."""
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Simulate the scenarios that have no file yet, and report goals."""
        # 1. model, data and goals; anything that does not fit is refused before the folder is touched
        exporters = [exporter_by_name(name) for name in self.export]
        policy = with_guidance(load_policy(self.model, self.device), self.guidance_scale)
        check_jobs(self.jobs, get_device(policy), "jobs")
        sampling = Sampling(self.temperature, self.top_k)
        scenarios = open_dataset(self.data, self.split)
        goals = read_given_goals(self.goals, self.goal, self.scenario)
        if goals.goals and not is_goal_conditioned(policy):
            raise ConfigError(
                f"{self.model} is not goal-conditioned, {len(goals.goals)} goals would have no effect: take a model "
                "that was fine-tuned with goals (docs/goals.md), or leave --goal and --goals out."
            )
        if self.guidance_scale != 1.0 and not goals.goals:
            raise ConfigError(
                f"--guidance-scale {self.guidance_scale:g} has no effect without goals: add --goal or --goals."
            )
        ids = list(dict.fromkeys(self.scenario or goals.scenario_ids or scenarios.scenario_ids))[: self.limit]
        for scenario_id in ids:
            entries = goals.of_scenario(scenario_id)
            check_splits(scenarios, scenario_id, self.data, "--scenario" if self.scenario else next(iter(entries), ""))
            if entries:
                warn_of_doubts(entries, scenarios.by_id(scenario_id))
            elif goals.goals:
                log.info(f"  scenario {scenario_id} has no goals: it is simulated without.")
        check_sampling(policy, scenarios, sampling)
        # 2. simulate what is missing; a folder of other rollouts is refused
        simulation = Simulation(policy, scenarios, self.num_rollouts, self.seed, sampling, goals)
        runner = self.work.runner(self.jobs, self.work.on_error) or choose_runner(self.jobs, len(ids))
        simulate_folder(simulation, ids, self.out, model=self.model, runner=runner)
        # 3. outcomes of goals, also of rollouts that an earlier call has written
        reported = [scenarios.by_id(i) for i in ids if goals.of_scenario(i) or self.picture]
        report_outcomes(self.out, reported, goals, picture=self.picture)
        # 4. further files, likewise
        for scenario in map(scenarios.by_id, ids if exporters else ()):
            states = read_rollouts(self.out, scenario)
            for export in exporters:
                print(export(scenario, states, self.out))
        print(f"{self.out}: {self.num_rollouts} rollouts of {len(ids)} scenarios.")
        return 0
