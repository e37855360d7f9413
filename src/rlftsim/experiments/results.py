"""Experiments and results: tables, verdicts and a figure, written as Markdown, JSON and pictures.

A new experiment is two functions: `run` trains and evaluates, `summarize` makes tables and verdicts of that.
`experiments.tables` makes tables of rows, `Row.against` makes verdicts. `EXPERIMENTS` in
`experiments.registry` has all experiments by name.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from matplotlib.figure import Figure

from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.jobs.documents import to_finite
from rlftsim.jobs.files import write_text
from rlftsim.jobs.folder import check_folder
from rlftsim.training.run_folder import describe_environment, to_plain
from rlftsim.viewer.figure import save_figure
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, write_page


@dataclass(frozen=True)
class ExperimentResult:
    """Tables, verdicts and a figure of an experiment."""

    title: str
    tables: tuple[TextTable, ...]
    """Ours first, then published ones."""
    verdicts: tuple[str, ...] = ()
    """A line each: difference or no difference."""
    notes: tuple[str, ...] = ()
    """Remarks needed to read the numbers."""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """The same for machines; what is not finite becomes null."""
    figure: Figure | None = None
    animations: tuple[Animation, ...] = ()


Measured = TypeVar("Measured")
FILMS = {".webp": 2, ".mp4": 1}
"""Endings of an animation's films and their steps between frames."""


@dataclass(frozen=True)
class Experiment(Generic[Measured]):
    """A question, and the two functions that answer it."""

    question: str
    run: Callable[[ExperimentSuite], Measured]
    """Trains and evaluates missing models, and returns the input of `summarize`: mostly the rows of a table."""
    summarize: Callable[[Measured, ExperimentSuite], ExperimentResult]
    """Computes from stored results alone."""
    default_seeds: int = 1
    needs_goals: bool = False
    """True = goal-conditioned models are trained, so a model that cannot be given goals is refused at once."""


def run_experiment(name: str, experiment: Experiment[Any], suite: ExperimentSuite) -> ExperimentResult:
    """Run the missing stages of an experiment and write the result, each file whole or not at all.

    Always NAME.md and NAME.json; with a figure NAME.png and NAME.svg; with animations NAME.html, a page
    with players, and films of each: NAME-1.webp, NAME-1.mp4, ...

    Args:
        name: Name of the experiment, with which all files begin.
        experiment: Question and the two functions that answer it.
        suite: Suite with the folder of the files; models and evaluations in the folder are not made again.

    Raises:
        RlftsimError: A stage failed; the message names stage and cause.
    """
    check_folder(suite.out, "results")
    if experiment.needs_goals:
        suite.check_goals()
    # 1. Train and evaluate what is missing, then make tables of stored results alone.
    result = experiment.summarize(experiment.run(suite), suite)
    # 2. Figure and films, before the page that shows them.
    if result.figure is not None:
        for ending in ("png", "svg"):
            save_figure(suite.out / f"{name}.{ending}", result.figure)
    for number, animation in enumerate(result.animations, 1):
        for ending, steps_per_frame in FILMS.items():
            to_film(suite.out / f"{name}-{number}{ending}", animation, steps_per_frame=steps_per_frame)
    if result.animations:
        write_page(suite.out / f"{name}.html", result.title, result.animations, caption=experiment.question)
    # 3. Everything for machines, with the settings that the numbers depend on.
    environment = describe_environment()
    for_machines = {
        "experiment": name,
        "question": experiment.question,
        "title": result.title,
        "verdicts": result.verdicts,
        "notes": result.notes,
        **result.numbers,
        "tables": [to_plain(table) for table in result.tables],
        "budget": to_plain(suite.budget),
        "num_seeds": suite.num_seeds,
        "data": str(suite.data),
        "recipe": to_plain(suite.recipe),
        "evaluation": to_plain(suite.evaluation),
        "environment": environment,
    }
    write_text(suite.out / f"{name}.json", json.dumps(to_finite(for_machines), indent=1) + "\n")
    # 4. The page for people.
    write_text(suite.out / f"{name}.md", _format_page(name, experiment, result, suite, environment))
    return result


def _format_page(
    name: str,
    experiment: Experiment[Any],
    result: ExperimentResult,
    suite: ExperimentSuite,
    environment: dict[str, Any],
) -> str:
    paragraphs = [f"# {result.title}", experiment.question]
    for table in result.tables:
        paragraphs += table.paragraphs
        # Verdicts and figure belong to the first table: ours. Published tables follow.
        if table is result.tables[0]:
            paragraphs += ["\n".join(f"* {line}" for line in result.verdicts)] if result.verdicts else []
            paragraphs += [f"![{result.title}]({name}.png)"] if result.figure is not None else []
    for number, animation in enumerate(result.animations, 1):
        film = f"{name}-{number}"
        caption = f"{animation.caption} [Film]({film}.mp4)"
        paragraphs += [f"## {animation.title}", caption, f"![Film of {animation.title}]({film}.webp)"]
    packages = ", ".join(f"{package} {version}" for package, version in environment["packages"].items())
    facts = (
        f"Data: {suite.data.name}, split {suite.evaluation.split}.",
        f"Made with {format_origin(environment)}, on {environment['machine']}; {packages}.",
    )
    paragraphs += ["## Notes", "\n".join(f"* {line}" for line in (*result.notes, *facts))]
    return "\n\n".join(paragraphs) + "\n"


def format_origin(environment: Mapping[str, Any]) -> str:
    """Command and commit of an environment, for the notes of a page."""
    return f"`{environment['command']}`, commit {environment['commit'] or 'of an installed package'}"
