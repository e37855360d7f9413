"""The verb that builds vocabularies and measures their coverage: tokens."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from rich.table import Table

from rlftsim.cli.recipe_verb import DEFAULT_RECIPE, RecipeVerb, value_of
from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import log, print_wide
from rlftsim.policies.smart.catk_vocabulary import read_catk_vocabulary
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.open import open_dataset
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.coverage import measure_coverage
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.viewer.vocabulary_report import ROWS, write_vocabulary_report

CACHED_SCENARIOS = 16
"""Each is read once or twice, in order."""


@dataclass(frozen=True)
class Tokens(RecipeVerb):
    """Build a vocabulary of motion and map tokens from a data set, and measure how well it covers the data.

    Writes FILE.safetensors and the folder FILE.report with a page, the numbers and a picture. With --check
    nothing is built: an existing vocabulary is compared with the data.
    """

    sections: ClassVar[tuple[str, ...]] = ("tokens",)

    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path | None = None
    """File to write, e.g. vocabulary.safetensors."""
    check: list[Path] = field(default_factory=list)
    """Instead of building: a vocabulary file, or npz tables of the public CAT-K code."""
    report: Path | None = None
    """Folder for the report. Left out, it is placed next to the vocabulary."""
    recipe: Annotated[str, tyro.conf.arg(metavar="RECIPE")] = DEFAULT_RECIPE
    """Recipe whose section tokens is used; `rlftsim recipe` lists all."""
    split: str = "training"
    """Split of the data set."""
    config: Path | None = None
    """JSON file of settings: the output of `rlftsim recipe NAME --json`. Flags override the file."""

    @classmethod
    def recipe_name_in(cls, words: Sequence[str]) -> str:
        """The value of `--recipe`."""
        return value_of("--recipe", words) or DEFAULT_RECIPE

    @classmethod
    def recipe_for(cls, name: str, words: Sequence[str]) -> Recipe:
        """The recipe of a command line, which must have a vocabulary.

        Args:
            name: of the recipe.
            words: the words behind the verb.

        Raises:
            ConfigError: it has none.
        """
        recipe = recipe_by_name(name)
        if recipe.tokens is None:
            raise ConfigError(f"recipe {name} has no vocabulary, so there is nothing to build.")
        return recipe

    def run(self) -> int:
        """Build or read a vocabulary, report its coverage, write it."""
        if (self.out is None) == (not self.check):
            raise ConfigError("tokens needs either --out FILE, to build a vocabulary, or --check FILE, to look at one.")
        config = self.settings.tokens or TokensConfig()
        if self.out is not None and self.out.suffix not in ("", ".safetensors"):
            raise ConfigError(
                f"--out {self.out}: vocabularies are safetensors files: name it {self.out.with_suffix('.safetensors')}."
            )
        if self.out is not None and self.out.exists():
            check_file(self.out)
            _refuse_foreign(self.out)
        # 1. the vocabulary, built or read
        scenarios = open_dataset(self.data, self.split, cache_size=CACHED_SCENARIOS)
        if self.out is not None:
            origin = f"{' '.join(sys.argv[1:])}; {len(scenarios)} scenarios; seed {config.seed}"
            vocabulary, radii = build_vocabulary(scenarios, config, origin=origin, show_progress=True)
            vocabulary.save(self.out)
            where = self.out
        else:
            # npz tables of the public CAT-K code come as one file or as two.
            where, radii = self.check[0], (None, None, None)
            is_ours = len(self.check) == 1 and where.suffix != ".npz"
            vocabulary = Vocabulary.load(where) if is_ours else read_catk_vocabulary(self.check)
        # 2. its coverage, measured on the same scenarios that it is built from
        sample = {"max_scenarios": config.max_scenarios, "seed": config.seed}
        classes = measure_coverage(scenarios, vocabulary, radii_m=radii, show_progress=True, **sample)
        folder = self.report or where.with_suffix(".report")
        compared = len(scenarios) if config.max_scenarios is None else min(len(scenarios), config.max_scenarios)
        write_vocabulary_report(
            folder, classes, vocabulary=where.name, data=f"{compared} scenarios of {self.data}, {self.split}"
        )
        # 3. the same numbers as in the report, on the terminal
        table = Table(title="How well the tokens cover the data", title_justify="left")
        table.add_column("")
        for coverage in classes:
            table.add_column(coverage.class_name, justify="right")
        for name, words in ROWS.items():
            table.add_row(name, *(words(coverage) for coverage in classes))
        print_wide(table)
        for coverage in classes:
            if coverage.num_tokens == 1 and coverage.use.sum() > 1:
                log.info(
                    f"{coverage.class_name}s have a single token, which stands still: their motion cannot be learned."
                )
        counts = ", ".join(f"{c.num_tokens} {c.class_name}" for c in classes)
        print(f"{where}: {counts} tokens, {len(vocabulary.map_prototypes)} map pieces. Report: {folder}/report.md")
        return 0


def _refuse_foreign(path: Path) -> None:
    """Refuse to overwrite a file that is not a vocabulary.

    Raises:
        ConfigError: it is something else.
    """
    try:
        Vocabulary.load(path)
    except DataError:
        raise ConfigError(f"{path} exists and is not a vocabulary: name another --out, or remove it.") from None
