"""The verb that lists plug-ins: plugins."""

from dataclasses import dataclass

from rich.table import Table

from rlftsim.plugins import POINTS, installed_plug_ins
from rlftsim.progress import print_wide


@dataclass(frozen=True)
class Plugins:
    """List what other installed packages add: rewards, policies, data sources, recipes, experiments, planners and
    exporters, with package and version, and the reason where one fails. Each is tried out: policies, planners and
    recipes are made.

    Exit status 1 if one fails. The others are used all the same.
    """

    def run(self) -> int:
        """Print the list."""
        found = installed_plug_ins()
        if not found:
            print(f"no installed package has an entry point in {', '.join(POINTS)}.")
            return 0
        table = Table()
        for heading in ("group", "name", "package", "version", "object", "state"):
            table.add_column(heading, overflow="fold")
        for one in found:
            table.add_row(one.group, one.name, one.package, one.version, one.value, "fails" if one.problem else "works")
        print_wide(table)
        for one in found:
            if one.problem:
                print(one.problem)
        return int(any(one.problem for one in found))
