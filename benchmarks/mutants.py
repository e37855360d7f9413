"""Mutants of every format that is read: each is read in a child of its own, and ends as a result or as one line.

python benchmarks/mutants.py [--mutants 500] [--seed 7] [--format NAME ...] [--family bytes] [--out table.md]
python benchmarks/mutants.py --format NAME --only FAMILY SEED FILE

Prints a Markdown table, and below it each kind of fault with the command that repeats it; exit status 1 for a fault.
Faults are tracebacks, signals, more than 10 s of computing, more than 2 GB above the undamaged file's memory, warnings
of libraries, and messages of more than a line. Formats and their samples are in tests/mutated_formats.py.
"""

import argparse
import json
import os
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "submission"), str(TESTS / "evaluation"), str(TESTS.parent / "docs")]

import pyarrow as pa  # noqa: E402

from mutant_runs import FAMILIES, HEADINGS, Mutant, Row, Sample, run_format  # noqa: E402
from mutated_formats import FORMATS  # noqa: E402


def markdown(rows: list[Row]) -> list[str]:
    """Lines of the table, with its sum."""
    cells = [row.cells() for row in rows]
    total = ["all", "", *(str(sum(int(row[k]) for row in cells)) for k in range(2, len(HEADINGS)))]
    return [f"| {' | '.join(line)} |" for line in (HEADINGS, ["---"] * len(HEADINGS), *cells, total)]


def faults(rows: list[Row]) -> list[str]:
    """Lines on the faults: each kind once, with how often it came and one mutant."""
    kinds: dict[tuple[str, str, str], list[Mutant]] = defaultdict(list)
    for row in rows:
        for mutant, outcome in row.faults:
            kinds[mutant.format, outcome.verdict, outcome.text].append(mutant)
    return [
        f"* {verdict} x {len(mutants)}, {' '.join(text.split())[:400]}: `{mutants[0]}`"
        for (_, verdict, text), mutants in kinds.items()
    ]


def outcomes(rows: list[Row]) -> dict[str, dict[str, Any]]:
    """Counts of verdicts and lines on the faults, by format."""
    by_format = {row.format: [one for one in rows if one.format == row.format] for row in rows}
    return {
        name: {"counts": sum((row.counts for row in some), Counter()), "faults": faults(some)}
        for name, some in by_format.items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=500)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--format", nargs="+", choices=FORMATS, default=[*FORMATS], metavar="NAME")
    parser.add_argument("--family", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--only", nargs=3, metavar=("FAMILY", "SEED", "FILE"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    if options.list:
        print(json.dumps({name: form.readers for name, form in FORMATS.items()}))
        return 0
    pa.set_cpu_count(1)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for number, name in enumerate(options.format):
            place = Path(folder) / str(number)
            if options.only:
                sample = Sample(name, place)
                family, seed, file = options.only
                print(sample.try_mutant(Mutant(name, family, seed, file, sample.files[file])))
                continue
            rows += run_format(name, place, options.seed, options.mutants, tuple(options.family))
            print(
                *(f"{' '.join(row.cells())} {row.seconds:.1f} s" for row in rows[-len(options.family) :]),
                sep="\n",
                file=sys.stderr,
                flush=True,
            )
    lines = [*markdown(rows), "", *faults(rows)] if rows else []
    print("\n".join(lines))
    if options.out and lines:
        options.out.write_text("\n".join(lines) + "\n")
    if options.json:
        options.json.write_text(json.dumps(outcomes(rows)))
    return int(any(row.faults for row in rows))


if __name__ == "__main__":
    sys.exit(main())
