"""The verbs by name, and all that a command line adds to the function of each."""

import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

from rlftsim.recipes.docstrings import read_field_texts, summarize_docstring

NO_DEFAULT = inspect.Parameter.empty
FLAG = re.compile(r"--[A-Za-z][\w.-]*")


@dataclass(frozen=True)
class Command:
    """A verb on the command line. Its flags are the arguments of a function, with the texts of the docstring."""

    location: str
    """Module and name of the function, "rlftsim.verbs.compare:compare"."""
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

    @property
    def module(self) -> str:
        """Name of the verb's module."""
        return self.location.partition(":")[0]

    @property
    def function(self) -> Callable[..., Any]:
        """The verb."""
        return getattr(import_module(self.module), self.location.partition(":")[2])

    @property
    def printer(self) -> Callable[..., Any] | None:
        """The function that prints the result; None where the verb prints."""
        return getattr(import_module(self.module), self.show) if self.show else None

    def parser(self, settings: Mapping[str, Any]) -> Callable[..., "Call"]:
        """A function for tyro, which reads its signature; makes the call of a command line.

        Args:
            settings: Settings by section, which become flags behind those of the verb.
        """
        function, printer = self.function, self.printer
        arguments = {name: argument for name, argument in read_arguments(function).items() if name not in self.hidden}
        if printer is not None:
            options = list(read_arguments(printer).values())[1:]  # behind the result
            arguments |= {option.name: option for option in options if option.name not in arguments}
        parameters = [self._parameter(arguments[name]) for name in (*self.positional, *arguments)]
        parameters += [Argument(name, Any, section, "").to_parameter() for name, section in settings.items()]
        parameters = list({parameter.name: parameter for parameter in parameters}.values())
        return with_parameters(lambda **values: Call(self, values), describe(function), parameters)

    def _parameter(self, argument: "Argument") -> inspect.Parameter:
        """An argument as tyro reads it."""
        name, label = argument.name, self.names.get(argument.name)
        if name in self.required:
            argument = Argument(name, without_none(argument.annotation), NO_DEFAULT, argument.text)
        if name in self.positional:
            return argument.to_parameter(tyro.conf.Positional, tyro.conf.arg(metavar=label or name.upper()))
        # flags of shared settings stand among those of the verb
        return argument.to_parameter(tyro.conf.arg(name="" if argument.settings is not None else label))


@dataclass(frozen=True)
class Call:
    """A verb with the values of a command line."""

    command: Command
    values: Mapping[str, Any]
    """Values by argument, of the verb and of the function that prints its result."""

    def run(self) -> int:
        """Call the verb and print its result; returns the exit status."""
        verb, printer = self.command.function, self.command.printer
        result = verb(**{name: self.values[name] for name in inspect.signature(verb).parameters if name in self.values})
        if printer is not None:
            _, *options = inspect.signature(printer).parameters
            result = printer(result, **{name: self.values[name] for name in options})
        return int(result or 0)


@dataclass(frozen=True)
class Argument:
    """An argument of a verb, or a field of settings."""

    name: str
    annotation: Any
    default: Any
    text: str

    @property
    def settings(self) -> Any:
        """Settings whose fields become flags, with their defaults; None for any other argument."""
        if is_dataclass(self.default):
            return self.default
        choices = get_args(self.annotation) or (self.annotation,)
        return next(
            (cls() for cls in choices if isinstance(cls, type) and is_dataclass(cls)),
            None,
        )

    def to_parameter(self, *markers: Any) -> inspect.Parameter:
        """The argument as tyro reads it, its text on one line; settings become the flags of their fields.

        Args:
            markers: Markers of tyro beside the text.
        """
        settings = self.settings
        if settings is None:
            annotation, default = to_flag_type(self.annotation), self.default
            markers = (*markers, *([tyro.conf.arg(help=self.text)] if self.text else []))
        else:
            annotation, default = Any, NO_DEFAULT
            markers = (*markers, tyro.conf.arg(constructor=settings_parser(settings)))
        if markers:
            annotation = Annotated[(annotation, *markers)]  # pyright: ignore
        return inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def read_arguments(function: Callable[..., Any]) -> dict[str, Argument]:
    """Arguments of a function by name: types, defaults, and texts of the docstring, each on one line.

    Args:
        function: Function whose docstring has a section `Args`.
    """
    # not by type hints: without torch the type of the result has no meaning
    parameters = inspect.signature(function).parameters
    _, _, section = (inspect.getdoc(function) or "").partition("\nArgs:\n")
    entries = re.split(r"^    (\w+): ", section.partition("\n\n")[0], flags=re.MULTILINE)
    texts = {name: " ".join(text.split()) for name, text in zip(entries[1::2], entries[2::2])}
    return {
        name: Argument(name, parameter.annotation, parameter.default, texts.get(name, ""))
        for name, parameter in parameters.items()
    }


def describe(function: Callable[..., Any]) -> str:
    """Docstring of a function up to its sections, each paragraph on one line."""
    text = re.split(r"^(?:Args|Returns|Raises):$", inspect.getdoc(function) or "", maxsplit=1, flags=re.MULTILINE)[0]
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in text.strip().split("\n\n"))


def settings_parser(settings: Any) -> Callable[..., Any]:
    """A function for tyro that makes settings of the same class; the values given are its defaults.

    Args:
        settings: Dataclass; fields that are dataclasses become groups of flags.
    """
    cls = type(settings)
    hints, texts = get_type_hints(cls, include_extras=True), read_field_texts(cls)
    arguments = [
        Argument(field.name, hints[field.name], getattr(settings, field.name), texts.get(field.name, ""))
        for field in fields(settings)
    ]
    return with_parameters(cls, summarize_docstring(cls), [argument.to_parameter() for argument in arguments])


def with_parameters(
    make: Callable[..., Any], description: str, parameters: Sequence[inspect.Parameter]
) -> Callable[..., Any]:
    """A function of some parameters that calls another one with their values by name.

    Args:
        make: Function to call.
        description: Docstring, which help texts begin with.
        parameters: Parameters of the signature.
    """

    # a lambda by another name: tyro would read through the wrapper that run-time type checks put around a function
    parser: Any = lambda **values: make(**values)  # noqa: E731
    parser.__name__ = "parser"
    parser.__signature__ = inspect.Signature(parameters)
    parser.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    parser.__doc__ = description
    return parser


def list_flags(words: Sequence[str]) -> list[str]:
    """Flags among words, without their values, as help texts write them."""
    return [word.partition("=")[0].replace("_", "-") for word in words if FLAG.match(word)]


def without_none(annotation: Any) -> Any:
    """A type without None, which nobody gives where a value is required."""
    choices = [cls for cls in get_args(annotation) if cls is not types.NoneType]
    return Union[tuple(choices)] if get_origin(annotation) in (Union, types.UnionType) else annotation  # noqa: UP007


def to_flag_type(annotation: Any) -> Any:
    """Type of a flag: T for `Annotated[Any, T]`, also within a union, else the annotation itself."""
    if get_origin(annotation) is Annotated and annotation.__origin__ is Any:
        return annotation.__metadata__[0]
    if get_origin(annotation) in (Union, types.UnionType):
        return Union[tuple(to_flag_type(choice) for choice in get_args(annotation))]  # noqa: UP007
    return annotation


FOLDER, MODEL = {"destination": "FOLDER"}, {"policy": "MODEL"}
FINETUNING = ("finetune", "catk", "road", "gcsl", "calibrate")
COMMANDS = {
    "demo": Command("rlftsim.verbs.demo:demo"),
    "doctor": Command("rlftsim.verbs.doctor:doctor"),
    "plugins": Command("rlftsim.verbs.plugins:plugins"),
    "convert": Command("rlftsim.verbs.convert:convert", ("source", "destination"), names={**FOLDER, "reader": "from"}),
    "data verify": Command("rlftsim.verbs.data:verify", ("data",)),
    "data stats": Command("rlftsim.verbs.data:stats", ("data",)),
    "data push": Command("rlftsim.verbs.data:push", ("folder", "url")),
    "data pull": Command("rlftsim.verbs.data:pull", ("url", "folder")),
    "synthesize": Command("rlftsim.verbs.synthesize:synthesize", ("destination",), names=FOLDER),
    "recipe": Command("rlftsim.verbs.recipe:recipe", ("name",), show="print_recipe"),
    "tokens": Command("rlftsim.verbs.tokens:tokens", sections=("tokens",)),
    "pretrain": Command(
        "rlftsim.verbs.pretrain:pretrain", ("policy",), ("out",), {"policy": "RECIPE", "scenarios": "data"},
        "print_model", ("model", "pretrain"), recipe="policy", hidden=("held_out",),
    ),
    "finetune": Command(
        "rlftsim.verbs.finetune:finetune", ("recipe",), ("recipe", "out"), {"policy": "model", "scenarios": "data"},
        "print_model", FINETUNING,
    ),
    "runs": Command("rlftsim.verbs.runs:runs", ("folders",), show="print_runs"),
    "augment": Command("rlftsim.verbs.augment:augment", ("model",)),
    "models": Command("rlftsim.verbs.model:list_models"),
    "model show": Command("rlftsim.verbs.model:show_model", ("model",)),
    "model average": Command("rlftsim.verbs.model:average_models", ("models",)),
    "model import": Command("rlftsim.verbs.model:import_model", ("checkpoint",), names={"format": "from"}),
    "model export": Command("rlftsim.verbs.model:export_model", ("model", "out"), names={"format": "to"}),
    "goals propose": Command("rlftsim.verbs.goals:propose_goals", ("data",)),
    "goals check": Command("rlftsim.verbs.goals:check_goals", ("file",)),
    "simulate": Command(
        "rlftsim.verbs.simulate:simulate", ("policy",), ("out",), {**MODEL, "scenarios": "data"}, "print_rollouts"
    ),
    "drive": Command("rlftsim.verbs.drive:drive", ("planner",)),
    "failures": Command("rlftsim.verbs.failures:failures", ("planner",)),
    "failures show": Command("rlftsim.verbs.failures:show_failure", ("folder", "number")),
    "studio": Command("rlftsim.verbs.studio:studio"),
    "score": Command("rlftsim.verbs.score:score", ("rollouts",), show="print_scores"),
    "evaluate": Command("rlftsim.verbs.evaluate:evaluate", ("policy",), ("out",), MODEL, "print_evaluation"),
    "compare": Command(
        "rlftsim.verbs.compare:compare", ("a", "b"), names={"a": "FIRST", "b": "SECOND"}, show="print_comparison"
    ),
    "submit build": Command("rlftsim.verbs.submit:build", ("model",)),
    "submit check": Command("rlftsim.verbs.submit:check", ("archive",)),
    "submit info": Command("rlftsim.verbs.submit:info", ("archive",)),
    "experiment": Command(
        "rlftsim.verbs.experiment:experiment", ("name",), sections=("tokens", "model", "pretrain", *FINETUNING)
    ),
    "experiment exam": Command("rlftsim.verbs.exam:exam"),
}  # fmt: skip
"""Verbs, and actions of verbs such as "data verify"."""
ACTIONS = {
    "data": "Check a data set for damage, print its statistics, or copy it to a bucket and back.",
    "model": "Show or average models, import a checkpoint of the public CAT-K code, or export a model to it.",
    "goals": "Propose goals for agents, or check a file of them.",
    "submit": "Build, check or describe an archive for the Sim Agents challenge (docs/submission.md).",
}
"""Verbs that have actions alone, and what they do in all."""
