"""Tables in the terminal."""

from rich.table import Table

from rlftsim.jobs.progress import print_wide


def test_no_control_character_of_a_name_reaches_the_terminal(capsys):
    table = Table(title="a\x1b[2J")
    table.add_column("b\x00")
    table.add_row("c\x1b[31m\x9b1m")
    print_wide(table)
    printed = capsys.readouterr().out
    assert "[31m" in printed
    assert all(sign.isprintable() or sign == "\n" for sign in printed)
