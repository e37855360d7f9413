"""`rlftsim tokens`: build a vocabulary, or measure its coverage."""

import sys
from collections.abc import Sequence
from pathlib import Path

from rich.table import Column, Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import log, print_line, print_wide
from rlftsim.policies.smart.catk_checkpoint import read_catk_vocabulary
from rlftsim.scenario.open import open_dataset
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.coverage import measure_coverage
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.verbs.arguments import RecipeOption, Settings
from rlftsim.verbs.inputs import check_config, to_recipe
from rlftsim.verbs.recipe_flags import DEFAULT_RECIPE, RecipeFlags
from rlftsim.viewer.vocabulary_report import ROWS, write_vocabulary_report

CACHED_SCENARIOS = 16
"""Each is read once or twice, in order."""


def adapt_flags(flags: RecipeFlags, words: Sequence[str]) -> RecipeFlags:
    """The flags as they are, of a recipe that has a vocabulary.

    Args:
        flags: Flags of the recipe.
        words: Words behind the command.

    Raises:
        ConfigError: It has none.
    """
    if flags.recipe.tokens is None:
        raise ConfigError(f"recipe {flags.name} has no vocabulary, so there is nothing to build.")
    return flags


def tokens(
    data: str,
    out: Path | None = None,
    *,
    check: tuple[Path, ...] = (),
    report: Path | None = None,
    recipe: RecipeOption = DEFAULT_RECIPE,
    split: str = "training",
    config: Settings | None = None,
) -> None:
    """Build a vocabulary of motion and map tokens from a data set, and measure how well it covers the data.

    Writes FILE.safetensors and the folder FILE.report with a page and a picture. With --check
    nothing is built: an existing vocabulary is compared with the data.

    Args:
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: File to write, e.g. vocabulary.safetensors.
        check: Vocabulary file, or npz tables of the public CAT-K code, to look at instead of building one.
        report: Folder for the report. Left out, it is placed next to the vocabulary.
        recipe: Recipe whose section tokens is used; `rlftsim recipe` lists all.
        split: Split of the data set.
        config: JSON file of settings: the output of `rlftsim recipe NAME --json`. Flags override the file. In Python
            `TokensConfig`, in place of the recipe's.

    Raises:
        ConfigError: Neither or both of a file to write and one to check, or a file that is no vocabulary.
        DataError: No such data set or split, or damaged tables.
    """
    if (out is None) == (not check):
        raise ConfigError("tokens needs either --out FILE, to build a vocabulary, or --check FILE, to look at one.")
    check_config(config, "tokens", TokensConfig)
    settings = config if isinstance(config, TokensConfig) else to_recipe(recipe).tokens or TokensConfig()
    if out is not None and out.suffix not in ("", ".safetensors"):
        raise ConfigError(
            f"--out {out}: vocabularies are safetensors files: name it {out.with_suffix('.safetensors')}."
        )
    if out is not None and out.exists():
        check_file(out)
        _check_is_vocabulary(out)
    # 1. the vocabulary, built or read
    scenarios = open_dataset(data, split, cache_size=CACHED_SCENARIOS)
    if out is not None:
        origin = f"{' '.join(sys.argv[1:])}; {len(scenarios)} scenarios; seed {settings.seed}"
        vocabulary, radii = build_vocabulary(scenarios, settings, origin=origin, show_progress=True)
        vocabulary.save(out)
        source = out
    else:
        # npz tables of the public CAT-K code come as one file or as two.
        source, radii = check[0], (None, None, None)
        is_ours = len(check) == 1 and source.suffix != ".npz"
        vocabulary = Vocabulary.load(source) if is_ours else read_catk_vocabulary(check)
    # 2. its coverage, measured on the same scenarios that it is built from
    sample = {"max_scenarios": settings.max_scenarios, "seed": settings.seed}
    classes = measure_coverage(scenarios, vocabulary, radii_m=radii, show_progress=True, **sample)
    folder = report or source.with_suffix(".report")
    compared = len(scenarios) if settings.max_scenarios is None else min(len(scenarios), settings.max_scenarios)
    write_vocabulary_report(folder, classes, vocabulary=source.name, data=f"{compared} scenarios of {data}, {split}")
    # 3. the same numbers as in the report, on the terminal
    columns = (Column(coverage.class_name, justify="right") for coverage in classes)
    table = Table("", *columns, title="How well the tokens cover the data")
    for name, words in ROWS.items():
        table.add_row(name, *(words(coverage) for coverage in classes))
    print_wide(table)
    for coverage in classes:
        if coverage.num_tokens == 1 and coverage.use.sum() > 1:
            log.info(f"{coverage.class_name}s have a single token, which stands still: their motion cannot be learned.")
    counts = ", ".join(f"{c.num_tokens} {c.class_name}" for c in classes)
    print_line(f"{source}: {counts} tokens, {len(vocabulary.map_prototypes)} map pieces. Report: {folder}/report.md")


def _check_is_vocabulary(path: Path) -> None:
    """Check that a file may be overwritten because it is a vocabulary.

    Raises:
        ConfigError: It is something else.
    """
    try:
        Vocabulary.load(path)
    except DataError:
        raise ConfigError(f"{path} exists and is not a vocabulary: name another --out, or remove it.") from None
