"""The verb that rolls scenarios out: simulate."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import Positional

from rlftsim.cli.data import open_split, refuse_unknown
from rlftsim.cli.goal_outcomes import outcome_table, outcomes_of, picture_of, read_rollouts
from rlftsim.cli.goals import goals_asked, warn_of_doubts
from rlftsim.errors import ConfigError, DataError
from rlftsim.files import write_text
from rlftsim.goals.goals_file import GoalsFile
from rlftsim.goals.placing import goals_of_batch
from rlftsim.progress import print_wide, progress_bar, say
from rlftsim.recipes.models import Device, load_policy
from rlftsim.rollout.files import write_rollouts
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling, device_of, sees_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.goal_picture import draw_goals

ABOUT = "rollouts.json"
"""Whose rollouts are in the folder."""
PICTURE_INCHES = 7.0


@dataclass(frozen=True)
class Simulate:
    """Simulate futures of scenarios: every agent, the ego included, moves by the model for 8 seconds.

    Writes one npz a scenario: scenario_id, object_ids [A], x y z heading [N, A, 80], world frame. Files that are there are kept,
    so an interrupted run goes on where it was.
    """

    model: Positional[str]
    """Model folder, or "constant_velocity"."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder for the rollouts."""
    split: str = "validation"
    scenario: list[str] | None = None
    """Only these scenario ids."""
    num_rollouts: int = 32
    seed: int = 0
    temperature: float = 1.0
    """Below 1 likely motions become likelier; 0 always takes the most likely one."""
    top_k: int | None = None
    """Sample among this many of the most likely motions only."""
    goal: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """AGENT=X,Y asks an agent of the one --scenario to go there, metres in the world frame of the record; may be given many times."""
    goals: Path | None = None
    """Goals file (docs/goals.md); without --scenario only its scenarios are simulated."""
    goal_guidance: float = 1.0
    """How many times the model's aim counts: above 1 goals are followed more closely than it learned to."""
    picture: bool = False
    """Draw OUT/SCENARIO.png: agents that have goals, or else the evaluated ones, and where they went."""
    device: Device = "auto"

    def run(self) -> int:
        """Simulate scenario by scenario."""
        if self.num_rollouts < 1:
            raise ConfigError(f"--num-rollouts must be at least 1, got {self.num_rollouts}.")
        if self.scenario is not None and not self.scenario:
            raise ConfigError("--scenario names none: give ids, or leave it out for all.")
        policy = load_policy(self.model, self.device, goal_guidance=self.goal_guidance)
        sampling = Sampling(self.temperature, self.top_k)
        scenarios = open_split(self.data, self.split)
        asked = self._goals_asked(policy)
        if self.goal_guidance != 1.0 and not asked.goals:
            raise ConfigError(
                f"--goal-guidance {self.goal_guidance:g} has no effect without goals: add --goal or --goals."
            )
        ids = list(dict.fromkeys(self.scenario or asked.scenario_ids or scenarios.scenario_ids))
        for scenario_id in ids:
            entries = asked.of_scenario(scenario_id)
            refuse_unknown(
                scenarios, scenario_id, self.data, "--scenario" if self.scenario else next(iter(entries), "")
            )
            if entries:
                warn_of_doubts(entries, scenarios.by_id(scenario_id))
            elif asked.goals:
                say(f"  scenario {scenario_id} has no goals: it is simulated without.")
        self._claim(policy, sampling, scenarios, asked)
        left = [i for i in ids if not (self.out / f"{i}.npz").exists()]
        with progress_bar("simulate", len(ids), len(ids) - len(left)) as advance:
            for scenario_id in left:
                batch = collate([scenarios.by_id(scenario_id)]).to(device_of(policy))
                entries = asked.of_scenario(scenario_id)
                goals = goals_of_batch(entries, batch) if entries else None
                rollouts = simulate(
                    policy, batch, num_rollouts=self.num_rollouts, seed=self.seed, sampling=sampling, goals=goals
                )
                write_rollouts(self.out, batch, rollouts)
                advance()
        self._report([scenarios.by_id(i) for i in ids if asked.of_scenario(i) or self.picture], asked)
        print(f"{self.out}: {self.num_rollouts} rollouts of {len(ids)} scenarios.")
        return 0

    def _goals_asked(self, policy: Policy) -> GoalsFile:
        """The goals of the command line.

        Raises:
            ConfigError: the model does not see goals.
            DataError: they make no sense.
        """
        asked = goals_asked(self.goals, self.goal, self.scenario)
        if asked.goals and not sees_goals(policy):
            raise ConfigError(
                f"{self.model} does not see goals, {len(asked.goals)} would have no effect: take a model that was fine-tuned with "
                "goals (docs/goals.md), or leave --goal and --goals out."
            )
        return asked

    def _report(self, scenarios: list[Scenario], asked: GoalsFile) -> None:
        """Say who got where it was asked to go, and draw."""
        outcomes, pictures = [], []
        for scenario in scenarios:
            states, entries = read_rollouts(self.out, scenario), asked.of_scenario(scenario.scenario_id)
            outcomes += outcomes_of(states, entries)
            if self.picture:
                pictures.append(self.out / f"{scenario.scenario_id}.png")
                draw_goals(pictures[-1], [picture_of(states, scenario, entries)], panel_inches=PICTURE_INCHES)
        if outcomes:
            print_wide(outcome_table(outcomes))
        for path in pictures:
            print(path)

    def _claim(self, policy: Policy, sampling: Sampling, scenarios: ScenarioDataset, asked: GoalsFile) -> None:
        """Write down whose rollouts these are; refuse a folder that holds others.

        Raises:
            ConfigError: it does.
        """
        about = {
            "model": self.model,
            "policy": fingerprint_policy(policy),
            "data": scenarios.manifest.index_sha256,
            "seed": self.seed,
            "num_rollouts": self.num_rollouts,
            "sampling": asdict(sampling),
        }
        if asked.goals:
            about["goals"] = [[e.scenario_id, e.agent_id, e.x, e.y] for e in asked.goals]
        path = self.out / ABOUT
        rollouts = sorted(self.out.glob("*.npz"))
        if rollouts and not path.exists():
            raise ConfigError(
                f"{self.out} holds {rollouts[0].name} but no {ABOUT}, so nobody knows whose rollouts it holds: name another --out."
            )
        old = _read_about(path) if path.exists() else about
        names = [name for name in {**about, **old} if name != "model"]
        differing = [name for name in names if old.get(name) != about.get(name)]
        if differing and rollouts:
            raise ConfigError(
                f"{self.out} holds rollouts of {old.get('model')} with another {', '.join(differing)}: name another --out."
            )
        write_text(path, json.dumps(about, indent=1) + "\n")


def _read_about(path: Path) -> dict[str, Any]:
    """What `Simulate` wrote down.

    Raises:
        DataError: it is damaged.
    """
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise DataError(
            f"{path}: damaged ({error}), so nobody knows whose rollouts {path.parent} holds: name another --out."
        ) from None
