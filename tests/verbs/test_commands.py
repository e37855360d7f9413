"""A verb is one function: its signature, its docstring and the help of the command agree word for word."""

import inspect
import re
import subprocess
import sys
from itertools import pairwise

import pytest

import rlftsim as rs
from rlftsim.cli.main import main, parse
from rlftsim.cli.signatures import read_arguments
from rlftsim.verbs.commands import COMMANDS


def help_words(command, capsys):
    """Help text of a command as words, without frames, so that its lines do not matter."""
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().out).split())


def flag_of(command, argument):
    """Flag or word of an argument in the help of its command."""
    label = command.names.get(argument.name)
    if argument.name in command.positional:
        return label or argument.name.upper()
    return f"--{(label or argument.name).replace('_', '-')}"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_each_argument_of_the_function_with_its_text_word_for_word(name, capsys):
    command, words = COMMANDS[name], help_words(name, capsys)
    arguments = read_arguments(command.function)
    assert [*arguments] == [*inspect.signature(command.function).parameters]
    for argument in arguments.values():
        assert argument.text, argument.name
        assert argument.text[0].isupper() or not argument.text[0].isalpha(), argument.text
        if argument.settings is None and argument.name not in command.hidden:
            flag = flag_of(command, argument)
            assert re.search(rf"(?<![\w-]){re.escape(flag)}(?![\w-])", words), flag
            # long words such as a path may be cut at a hyphen
            assert re.search(rf"{re.escape(argument.text)} \((default|required|repeatable)", words), (
                flag,
                argument.text,
            )


@pytest.mark.parametrize("name", [name for name in COMMANDS if name in rs.__all__])
def test_a_verb_in_python_is_the_very_function_that_its_command_runs(name):
    assert getattr(rs, name) is COMMANDS[name].function
    assert COMMANDS[name].function.__name__ == name


@pytest.mark.parametrize("columns", ["80", "120"])
@pytest.mark.parametrize("name", COMMANDS)
def test_no_line_of_help_ends_though_the_next_word_has_room(name, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit):
        main([*name.split(), "--help"])
    for box in re.findall(r"^╭.*?^╰", capsys.readouterr().out, re.M | re.S):
        lines = [line.removeprefix("│").rstrip("│").rstrip() for line in box.splitlines()[1:-1]]
        width = max(map(len, lines))
        for line, following in pairwise(lines):
            if re.match(r" {6,}\S", following) and re.match(r" {6,}\S", line):
                assert len(line) + 1 + len(following.split()[0]) > width, (line, following)


def test_a_result_is_printed_by_a_function_that_takes_arguments_of_the_verb():
    for command in COMMANDS.values():
        if command.printer is not None:
            _, *options = read_arguments(command.printer).values()
            assert all(option.text for option in options)


def test_a_command_line_gives_the_function_its_arguments_under_their_names():
    call = parse(["evaluate", "oracle", "--data", "synthetic", "--out", "o", "--top-k", "3", "--share", "1/2"])
    assert (call.values["policy"], call.values["data"], str(call.values["out"])) == ("oracle", "synthetic", "o")
    assert (call.values["sampling"], call.values["work"].share) == (rs.Sampling(top_k=3), "1/2")


def test_types_of_arguments_import_no_torch():
    code = "import sys, rlftsim.verbs.arguments; print('torch' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"
