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
TRIALS = {
    "rlftsim.features": "rlftsim.verbs.plugin_trials:try_feature",
    "rlftsim.constraints": "rlftsim.verbs.plugin_trials:try_constraint",
}
"""Entry-point group -> module and name of a trial by name, with torch; an error says what is wrong."""


def try_plug_ins() -> Iterator[tuple[EntryPoint, str | None]]:
    """Entry points of installed packages in all groups, and the reason where one cannot be used: each is tried out."""
    for group, location in POINTS.items():
        for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
            # The group itself may need an extra that is not installed.
            try:
                point = _load(location)
                problem = point.describe_problem(entry) or point.describe_refusal(entry.name)
                if problem is None and group in TRIALS:
                    problem = point.describe_refusal(entry.name, _load(TRIALS[group]))
                if problem is None and group == "rlftsim.rewards":
                    problem = describe_failures(entry)
            except ConfigError as error:
                problem = str(error)
            yield entry, problem


def _load(location: str) -> Any:
    module, _, attribute = location.partition(":")
    return getattr(importlib.import_module(module), attribute)


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
