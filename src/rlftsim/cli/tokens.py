"""The verb that builds vocabularies and says how good they are: tokens."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from rlftsim.cli.data import open_split
from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.vocabulary_report import ROWS, write_vocabulary_report
from rlftsim.policies.smart.catk_vocabulary import read_catk_vocabulary
from rlftsim.progress import print_wide, say
from rlftsim.recipes.configure import Override, configure
from rlftsim.recipes.smart import RECIPES, RecipeName
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.coverage import ClassCoverage, measure_coverage
from rlftsim.tokens.vocabulary import Vocabulary

CACHED_SCENARIOS = 16
"""Each is read once or twice, in order."""


@dataclass(frozen=True)
class Tokens:
    """Build a vocabulary of motion and map tokens from a data set, and say how well it covers the data.

    Beside FILE.safetensors stands the folder FILE.report with a page, the numbers and a picture. With --check nothing is built:
    an existing vocabulary is compared with the data.
    """

    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path | None = None
    """File to write, e.g. vocabulary.safetensors."""
    check: list[Path] = field(default_factory=list)
    """Instead of building: a vocabulary file, or npz tables of the public CAT-K code."""
    report: Path | None = None
    """Folder for the report; left out, it stands beside the vocabulary."""
    recipe: RecipeName = "smart-tiny"
    split: str = "training"
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. tokens.num_tokens=1024 or tokens.kind=trajtok."""

    def run(self) -> int:
        """Build or read, report, write."""
        if (self.out is None) == (not self.check):
            raise ConfigError("tokens needs either --out FILE, to build a vocabulary, or --check FILE, to look at one.")
        config = configure(RECIPES[self.recipe](), self.set, sections=("tokens",)).tokens
        if self.out is not None and self.out.exists():
            _refuse_foreign(self.out)
        scenarios = open_split(self.data, self.split, cached=CACHED_SCENARIOS)
        if self.out is not None:
            origin = f"{' '.join(sys.argv[1:])}; {len(scenarios)} scenarios; seed {config.seed}"
            vocabulary, radii = build_vocabulary(scenarios, config, origin=origin, show_progress=True)
            vocabulary.save(self.out)
            where = self.out
        else:
            vocabulary, radii = _read(self.check), (None, None, None)
            where = self.check[0]
        classes = measure_coverage(
            scenarios, vocabulary, radii_m=radii, max_scenarios=config.max_scenarios, seed=config.seed, show_progress=True
        )  # fmt: skip
        folder = self.report or where.with_suffix(".report")
        compared = f"{self._num_compared(len(scenarios), config)} scenarios of {self.data}, {self.split}"
        write_vocabulary_report(folder, classes, vocabulary=where.name, data=compared)
        print_wide(_coverage_table(classes))
        for coverage in classes:
            if coverage.num_tokens == 1 and coverage.use.sum() > 1:
                say(
                    f"{coverage.class_name}s have a single token, which stands still: nothing can be learned of how they move."
                )
        counts = ", ".join(f"{c.num_tokens} {c.class_name}" for c in classes)
        print(f"{where}: {counts} tokens, {len(vocabulary.map_prototypes)} map pieces. Report: {folder}/report.md")
        return 0

    def _num_compared(self, num_scenarios: int, config: TokensConfig) -> int:
        return num_scenarios if config.max_scenarios is None else min(num_scenarios, config.max_scenarios)


def _refuse_foreign(path: Path) -> None:
    """Refuse to write over what is no vocabulary.

    Raises:
        ConfigError: it is something else.
    """
    try:
        Vocabulary.load(path)
    except DataError:
        raise ConfigError(f"{path} is there and no vocabulary: name another --out, or remove it.") from None


def _read(paths: list[Path]) -> Vocabulary:
    if len(paths) == 1 and paths[0].suffix != ".npz":
        return Vocabulary.load(paths[0])
    return read_catk_vocabulary(paths)


def _coverage_table(classes: tuple[ClassCoverage, ...]) -> Table:
    table = Table(title="How well the tokens stand for the data", title_justify="left")
    table.add_column("")
    for coverage in classes:
        table.add_column(coverage.class_name, justify="right")
    for name, words in ROWS.items():
        table.add_row(name, *(words(coverage) for coverage in classes))
    return table
