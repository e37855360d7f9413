"""Tables in the terminal."""

import ast
import re
import sys
from pathlib import Path

import pytest
from rich.table import Table

import rlftsim
from rlftsim.jobs.progress import log, print_line, print_lines, print_wide, progress_bar


def test_no_control_character_of_a_name_reaches_the_terminal(capsys):
    table = Table(title="a\x1b[2J")
    table.add_column("b\x00")
    table.add_row("c\x1b[31m\x9b1m")
    print_wide(table)
    printed = capsys.readouterr().out
    assert "[31m" in printed
    assert all(sign.isprintable() or sign == "\n" for sign in printed)


def test_lines_and_messages_show_no_control_character(capsys):
    scenario_id = "a\x9b31m\u202eb\x7f\n"
    print_line(f"skipped {scenario_id}: no lane")
    print_line(f"skipped {scenario_id}: no lane", sys.stderr)
    log.warning(f"{scenario_id} is left out\nin two lines")
    printed = capsys.readouterr()
    assert printed.out == "skipped a 31m b  : no lane\n"
    assert printed.err == "skipped a 31m b  : no lane\na 31m b \n is left out\nin two lines\n"


def test_no_line_of_a_verb_reaches_the_terminal_as_it_is():
    """Names of users' files hold any sign; the command line, and a studio's own address, print no such name."""
    package = Path(rlftsim.__file__).parent
    printing = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert printing == {"jobs/progress.py", "cli/main.py", "cli/parse.py", "studio/server.py"}


def test_lines_of_a_card_stay_lines_without_control_characters(capsys):
    print_lines("# a\x1b[2J\n\n* b\x07" + "c" * 1000)
    assert capsys.readouterr().out == "# a [2J\n\n* b " + "c" * 1000 + "\n"


def test_a_long_name_is_printed_without_its_middle(capsys):
    print_line("a" * 100_000)
    assert "characters and more" in capsys.readouterr().out


@pytest.mark.parametrize("columns", [40, 80, 120])
def test_no_cell_of_a_table_is_cut_whatever_the_width(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    table = Table()
    table.add_column("label", no_wrap=True)
    for number in range(6):
        table.add_column(f"a_name_of_a_model_{number}", justify="right")
    table.add_row("a label that may not be broken", *["0.7965 ± 0.0193"] * 6)
    print_wide(table)
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= columns
    assert out.count("±") == 6
    assert sum(out.count(sign) for sign in "0123456789") == 6 * 10 + 6
    assert len(re.findall(r"[a-z]", out)) == len("labelalabelthatmaynotbebroken") + 6 * len("anameofamodel")


@pytest.mark.parametrize(("total", "counts"), [(3, (2, 1, 0, 0)), (0, (0,))])
def test_the_end_of_long_work_is_said_once(total, counts, capsys):
    with progress_bar("check", total, unit="bytes") as advance:
        for count in counts:
            advance(count)
    assert capsys.readouterr().err.count("check: 100%") == 1
