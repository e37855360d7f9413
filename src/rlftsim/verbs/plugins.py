"""`rlftsim plugins`: what other packages add."""

import importlib
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from rich.table import Table

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_line, print_wide

POINTS = {
    "rlftsim.policies": "rlftsim.policies.registry:POLICIES",
    "rlftsim.recipes": "rlftsim.recipes.registry:RECIPES",
    "rlftsim.methods": "rlftsim.training.registry:METHODS",
    "rlftsim.rewards": "rlftsim.rewards:REWARDS",
    "rlftsim.sources": "rlftsim.scenario.sources:SOURCES",
    "rlftsim.features": "rlftsim.policies.calibrated.features:FEATURES",
    "rlftsim.constraints": "rlftsim.training.constraints:CONSTRAINTS",
    "rlftsim.planners": "rlftsim.envs.planners.registry:PLANNERS",
    "rlftsim.experiments": "rlftsim.experiments.registry:EXPERIMENTS",
    "rlftsim.trackers": "rlftsim.training.trackers:TRACKERS",
    "rlftsim.entries": "rlftsim.rollout.entries:ENTRIES",
    "rlftsim.exporters": "rlftsim.evaluation.exporters:EXPORTERS",
}
"""Entry-point group -> module and name of its `ExtensionPoint`."""


def try_plug_ins() -> Iterator[tuple[EntryPoint, str | None]]:
    """Entry points of installed packages in all groups, and the reason where one cannot be used: each is tried out."""
    for group, location in POINTS.items():
        for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
            module, _, attribute = location.partition(":")
            # The group itself may need an extra that is not installed.
            try:
                point = getattr(importlib.import_module(module), attribute)
                problem = point.describe_problem(entry) or point.describe_refusal(entry.name)
                if problem is None and group in TRIALS:
                    problem = point.describe_refusal(entry.name, TRIALS[group])
                if problem is None and group == "rlftsim.rewards":
                    problem = describe_failures(entry)
            except ConfigError as error:
                problem = str(error)
            yield entry, problem


def describe_failures(entry: EntryPoint) -> str | None:
    """One line about the rules that rewards of a package break, on two small scenarios; None = no rule is broken."""
    from rlftsim.rewards import REWARDS  # imported late, with torch: few packages have rewards
    from rlftsim.verbs.check_reward import check_reward

    names = [entry.name]
    if REWARDS.find(entry.name) is None:  # a module that registers rewards by other names
        modules = {name: getattr(REWARDS.get(name), "__module__", None) or "" for name in REWARDS.names()}
        names = [name for name, module in modules.items() if module.partition(".")[0] == entry.value.partition(".")[0]]
    for name in names:
        failures = check_reward(name).failures
        if failures:
            broken = "; ".join(f"{failure.rule}: {failure.detail}" for failure in failures)
            return f"reward {name!r} of {entry.value} breaks the contract, see rs.check_reward: {broken}."
    return None


def try_constraint(name: str) -> None:
    """Ask a constraint for its shares in rollouts of two small scenarios, as runs do.

    Args:
        name: Name of a registered constraint.
    """
    from rlftsim.policies.registry import load_policy  # imported late, with torch
    from rlftsim.realism import score_rollouts
    from rlftsim.rollout.simulate import simulate
    from rlftsim.scenario.batch import collate
    from rlftsim.training.constraints import constraint_by_name
    from rlftsim.verbs.check_reward import find_small_scenarios

    batch = collate(find_small_scenarios())
    rollouts = simulate(load_policy("demo-base", "cpu"), batch, num_rollouts=2, seed=0)
    constraint_by_name(name).split(batch, rollouts, score_rollouts(batch, rollouts, "2025")[1])


def try_feature(name: str) -> None:
    """Let a feature weigh in a second of two small scenarios, as in rollouts of calibration.

    Args:
        name: Name of a registered feature.
    """
    from rlftsim.policies.calibrated.policy import CalibratedPolicy  # imported late, with torch
    from rlftsim.policies.registry import load_policy
    from rlftsim.rollout.simulate import simulate
    from rlftsim.scenario.batch import collate
    from rlftsim.verbs.check_reward import find_small_scenarios

    policy: Any = CalibratedPolicy(load_policy("demo-base", "cpu"), [name], eta=[1.0])
    simulate(policy, collate(find_small_scenarios()), num_rollouts=1, seed=0, num_steps=10)


TRIALS = {"rlftsim.constraints": try_constraint, "rlftsim.features": try_feature}
"""Entry-point group -> trial by name; an error says what is wrong."""


def plugins() -> int:
    """List what other installed packages add, with package and version, and the reason where one fails.

    Each is tried out, of rewards, policies, training methods, data sources, recipes, experiments, planners, trackers
    and exporters: policies, planners and recipes are made, rewards, constraints and features are checked on two small
    scenarios. The exit status is 1 if one fails. The others are used all the same.
    """
    plug_ins = list(try_plug_ins())
    if not plug_ins:
        print_line(f"no installed package has an entry point in {', '.join(POINTS)}.")
        return 0
    table = Table("group", "name", "package", "version", "object", "state")
    for entry, problem in plug_ins:
        package, version = (entry.dist.name, entry.dist.version) if entry.dist else ("", "")
        table.add_row(entry.group, entry.name, package, version, entry.value, "fails" if problem else "works")
    print_wide(table)
    problems = [problem for _, problem in plug_ins if problem]
    for problem in problems:
        print_line(problem)
    return int(bool(problems))
