"""Signatures and docstrings of verbs, in the form in which tyro makes flags of them."""

import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

from rlftsim.recipes.docstrings import read_field_texts, summarize_docstring
from rlftsim.verbs.commands import Command

NO_DEFAULT = inspect.Parameter.empty
FLAG = re.compile(r"--[A-Za-z][\w.-]*")


@dataclass(frozen=True)
class Call:
    """A verb with the values of a command line."""

    command: Command
    values: Mapping[str, Any]
    """Values by argument, of the verb and of the function that prints its result."""

    @property
    def arguments(self) -> dict[str, Any]:
        """Values of the verb's own arguments."""
        names = inspect.signature(self.command.function).parameters
        return {name: self.values[name] for name in names if name in self.values}

    def show(self, result: Any) -> int:
        """Print the verb's result; returns the exit status."""
        printer = self.command.printer
        if printer is not None:
            _, *options = inspect.signature(printer).parameters
            result = printer(result, **{name: self.values[name] for name in options})
        return int(result or 0)


def make_parser(command: Command, settings: Mapping[str, Any]) -> Callable[..., Call]:
    """A function with a signature for tyro; makes the call of a command line.

    Args:
        command: Command whose function and printer have the arguments.
        settings: Settings by section, which become flags behind those of the verb.
    """
    function, printer = command.function, command.printer
    arguments = {name: argument for name, argument in read_arguments(function).items() if name not in command.hidden}
    if printer is not None:
        options = list(read_arguments(printer).values())[1:]  # behind the result
        arguments |= {option.name: option for option in options if option.name not in arguments}
    parameters = [_to_parameter(command, arguments[name]) for name in (*command.positional, *arguments)]
    parameters += [Argument(name, Any, section, "").to_parameter() for name, section in settings.items()]
    parameters = list({parameter.name: parameter for parameter in parameters}.values())
    return with_parameters(lambda **values: Call(command, values), describe(function), parameters)


def _to_parameter(command: Command, argument: "Argument") -> inspect.Parameter:
    """An argument of a command as tyro reads it."""
    name, label = argument.name, command.names.get(argument.name)
    if name in command.required:
        argument = Argument(name, to_required_type(argument.annotation), NO_DEFAULT, argument.text)
    if name in command.positional:
        return argument.to_parameter(tyro.conf.Positional, tyro.conf.arg(metavar=label or name.upper()))
    # flags of shared settings stand among those of the verb
    return argument.to_parameter(tyro.conf.arg(name="" if argument.settings is not None else label))


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
        return next((cls() for cls in choices if isinstance(cls, type) and is_dataclass(cls)), None)

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
    """Arguments of a function by name: types, defaults, and texts of the docstring, a line each.

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
    """A function of some parameters that calls a given function with the values by name.

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
    """Flags among words without values, as in help texts."""
    return [word.partition("=")[0].replace("_", "-") for word in words if FLAG.match(word)]


def to_required_type(annotation: Any) -> Any:
    """A type without None, for a required value."""
    choices = [cls for cls in get_args(annotation) if cls is not types.NoneType]
    return Union[tuple(choices)] if get_origin(annotation) in (Union, types.UnionType) else annotation  # noqa: UP007


def to_flag_type(annotation: Any) -> Any:
    """Type of a flag: T for `Annotated[Any, T]`, also within a union, else the annotation itself."""
    if get_origin(annotation) is Annotated and annotation.__origin__ is Any:
        return annotation.__metadata__[0]
    if get_origin(annotation) in (Union, types.UnionType):
        return Union[tuple(to_flag_type(choice) for choice in get_args(annotation))]  # noqa: UP007
    return annotation
