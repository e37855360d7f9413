"""The verbs by name, and all that a command line adds to the function of each. Imports no library."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

UNCHECKED: dict[Callable[..., Any], Callable[..., Any]] = {}
"""Function that checks names and numbers of arguments -> the function without the check."""


@dataclass(frozen=True)
class Command:
    """A verb on the command line. Its flags are the arguments of a function, with the texts of the docstring."""

    location: str
    """Module in `rlftsim.verbs` and name of the function, "compare:compare"."""
    positional: Sequence[str] = ()
    """Arguments that are written without a flag, in this order."""
    required: Sequence[str] = ()
    """Arguments that the command line requires though the function does not."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Argument -> flag, or word for a positional argument in help texts, where it is not the argument's name."""
    show: str | None = None
    """Name of the function in the same module that prints the result. It takes arguments of the verb by name, and may
    have further ones, which are flags too. It may return the exit status, as a verb without this function does."""
    sections: Sequence[str] = ()
    """Sections of a recipe whose fields are flags. A function `adapt_flags` in the same module may change them for a
    command line, and `check_flags` refuses what has no effect."""
    recipe: str = "recipe"
    """Argument that takes the recipe with the values of these flags, in place of its name."""
    hidden: Sequence[str] = ()
    """Arguments that only Python takes."""
    has_shares: bool = False
    """True for a command with the flag --share, whose shares `rlftsim join` puts together."""

    @property
    def module(self) -> str:
        """Name of the verb's module."""
        return f"rlftsim.verbs.{self.location.partition(':')[0]}"

    @property
    def function(self) -> Callable[..., Any]:
        """The verb."""
        return getattr(import_module(self.module), self.location.partition(":")[2])

    @property
    def printer(self) -> Callable[..., Any] | None:
        """The function that prints the result; None where the verb prints."""
        return getattr(import_module(self.module), self.show) if self.show else None


@dataclass(frozen=True)
class Verb:
    """A word behind `rlftsim`, with a command, or with a command for each of its actions."""

    summary: str
    """Line in the overview."""
    commands: Command | Mapping[str, Command]
    """The command, or commands by action, such as "verify"; "" = without an action."""
    description: str = ""
    """What the actions do in all, of a verb that has actions alone."""
    starts_anew: bool = False
    """True if nothing of an interrupted run is kept."""
    begins_group: bool = False
    """True for a verb behind an empty line of the overview."""


FOLDER, MODEL, DATA = {"destination": "FOLDER"}, {"policy": "MODEL"}, {"scenarios": "data"}
FINETUNING = ("finetune", "catk", "road", "gcsl", "calibrate")
VERBS = {
    "demo": Verb("run the whole pipeline on synthetic scenarios, in minutes, on a CPU", Command("demo:demo")),
    "doctor": Verb(
        "check this machine and print what to do about each problem",
        Command("doctor:doctor"), starts_anew=True,
    ),
    "plugins": Verb(
        "list what other installed packages add, and why one fails",
        Command("plugins:plugins"), starts_anew=True,
    ),
    "convert": Verb(
        "convert logged scenarios, such as WOMD tfrecords, to a portable data set",
        Command("convert:convert", ("source", "destination"), names={**FOLDER, "reader": "from"}, has_shares=True),
        begins_group=True,
    ),
    "data": Verb(
        "check a data set, or print its statistics",
        {
            "verify": Command("data:verify", ("data",)),
            "stats": Command("data:stats", ("data",)),
            "push": Command("data:push", ("folder", "url")),
            "pull": Command("data:pull", ("url", "folder")),
        },
        "Check a data set for damage, print its statistics, or copy it to a bucket and back.",
        starts_anew=True,
    ),
    "synthesize": Verb(
        "make synthetic scenarios with SUMO",
        Command("synthesize:synthesize", ("destination",), names=FOLDER, has_shares=True),
    ),
    "recipe": Verb(
        "list the recipes (models and training settings), or print one",
        Command("recipe:recipe", ("name",), show="print_recipe"), starts_anew=True, begins_group=True,
    ),
    "tokens": Verb(
        "build a vocabulary of motion and map tokens, or measure its coverage",
        Command("tokens:tokens", sections=("tokens",)), starts_anew=True,
    ),
    "pretrain": Verb(
        "train a model on logged tracks",
        Command("pretrain:pretrain", ("policy",), ("out",), {"policy": "RECIPE", "scenarios": "data"},
            "print_model", ("model", "pretrain"), recipe="policy", hidden=("held_out", "on_update")),
    ),
    "finetune": Verb(
        "fine-tune a model in closed loop with a realism reward, also with goals",
        Command("finetune:finetune", ("recipe",), ("recipe", "out"), {"policy": "model", "scenarios": "data"},
            "print_model", FINETUNING, hidden=("on_update",)),
    ),
    "distill": Verb(
        "train a small, fast model to decide like a large one",
        Command("distill:distill", ("policy",), ("out",), {"policy": "MODEL", "scenarios": "data"},
            "print_student"),
    ),
    "runs": Verb(
        "list training runs: how far they are, how good, and which settings differ",
        Command("runs:runs", ("folders",), show="print_runs"), starts_anew=True,
    ),
    "augment": Verb(
        "sample further goals for goal-conditioned fine-tuning",
        Command("augment:augment", ("model",), has_shares=True),
    ),
    "models": Verb(
        "list the models in the box and those of other packages",
        Command("model:list_models"), starts_anew=True,
    ),
    "model": Verb(
        "average or upload models; import a checkpoint of the public CAT-K code, or export one",
        {
            "show": Command("model:show_model", ("model",)),
            "average": Command("model:average_models", ("models",)),
            "import": Command("model:import_model", ("checkpoint",), names={"format": "from"}),
            "export": Command("model:export_model", ("model", "out"), names={"format": "to"}),
            "push": Command("model:push_model", ("model", "url")),
        },
        "Show, average or upload models, import a checkpoint of the public CAT-K code, or export a model to it.",
        starts_anew=True,
    ),
    "goals": Verb(
        "propose goals for agents and write a goals file, or check one",
        {
            "propose": Command("goals:propose_goals", ("data",)),
            "check": Command("goals:check_goals", ("file",)),
        },
        "Propose goals for agents, or check a file of them.",
        starts_anew=True,
    ),
    "simulate": Verb(
        "roll out scenarios with a model",
        Command("simulate:simulate", ("policy",), ("out",), {**MODEL, **DATA}, "print_rollouts", has_shares=True),
    ),
    "entries": Verb(
        "learn from long logs who enters a world",
        {"fit": Command("entries:fit", ("data", "out"))},
        "Learn from long logs who enters a world.", starts_anew=True,
    ),
    "export": Verb(
        "write stored rollouts as files that other programs read",
        Command("export:export", ("exporter", "rollouts", "out"), ("scenarios",), {"exporter": "FORMAT", **DATA}),
        starts_anew=True,
    ),
    "drive": Verb("let a planner drive among simulated traffic, and score both", Command("drive:drive", ("planner",))),
    "failures": Verb(
        "estimate how often a planner fails in realistic traffic, and show how",
        {
            "": Command("failures:failures", ("planner",), has_shares=True),
            "show": Command("failures:show_failure", ("folder", "number")),
        },
    ),
    "studio": Verb(
        "ask agents for things in the browser, and look at what happens",
        Command("studio:studio"), starts_anew=True,
    ),
    "serve": Verb(
        "serve traffic to other simulators",
        {"alpasim": Command("serve:serve_alpasim")},
        "Serve traffic to other simulators.", starts_anew=True,
    ),
    "score": Verb(
        "score rollouts of any simulator with the official realism meta-metric",
        Command("score:score", ("rollouts",), names=DATA, show="print_scores", has_shares=True),
        begins_group=True,
    ),
    "evaluate": Verb(
        "evaluate a model with the official realism meta-metric",
        Command("evaluate:evaluate", ("policy",), ("out",), MODEL, "print_evaluation", has_shares=True),
    ),
    "compare": Verb(
        "compare evaluations scenario by scenario",
        Command("compare:compare", ("a", "b", "others"), names={"a": "FIRST", "b": "SECOND"}, show="print_comparison"),
        starts_anew=True,
    ),
    "report": Verb(
        "write a page that compares evaluated models, with films of the worst scenarios",
        Command("report:report", ("results",), names={"runs": "run"}, show="print_report"),
    ),
    "submit": Verb(
        "build an archive for the Sim Agents or scenario generation leaderboard, or check one",
        {
            "build": Command("submit:build", ("model",), has_shares=True),
            "check": Command("submit:check", ("archive",)),
            "info": Command("submit:info", ("archive",)),
        },
        "Build, check or describe an archive for a challenge of the Waymo Open Dataset (docs/submission.md).",
    ),
    "experiment": Verb(
        "repeat an experiment of the paper: a table, verdicts and a figure; or sit the exam",
        {
            "": Command("experiment:experiment", ("name",), sections=("tokens", "model", "pretrain", *FINETUNING)),
            "exam": Command("exam:exam"),
            "true-world": Command("true_world:true_world", has_shares=True),
        },
    ),
}  # fmt: skip
"""Verbs in the order in which a newcomer needs them."""
COMMANDS = {
    f"{name} {action}".strip(): command
    for name, verb in VERBS.items()
    for action, command in ({"": verb.commands} if isinstance(verb.commands, Command) else verb.commands).items()
}
"""Commands by verb, or by verb and action such as "data verify"."""
