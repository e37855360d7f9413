"""Tables in the terminal."""

import sys

from rich.table import Table

from rlftsim.jobs.progress import log, print_line, print_wide


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


def test_a_long_name_is_printed_without_its_middle(capsys):
    print_line("a" * 100_000)
    assert "characters and more" in capsys.readouterr().out
