"""The report on a vocabulary: a folder with a page to read, the numbers, and a picture."""

import json
import os
import shutil
from pathlib import Path

import numpy as np

from rlftsim.errors import DataError
from rlftsim.tokens.coverage import ClassCoverage, Spread
from rlftsim.viewer.coverage_picture import coverage_picture

PAGE, NUMBERS, PICTURE = "report.md", "report.json", "picture.png"


def write_vocabulary_report(folder: Path, classes: tuple[ClassCoverage, ...], *, vocabulary: str, data: str) -> None:
    """Write `report.md`, `report.json` and `picture.png` into a folder, all of them or none; an earlier report gives way.

    Args:
        folder: the report.
        classes: what `measure_coverage` returned.
        vocabulary: which vocabulary it is, in words.
        data: what it was compared with, in words.

    Raises:
        DataError: the folder holds something else, or cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and {p.name for p in folder.iterdir()} <= {PAGE, NUMBERS, PICTURE}):
        raise DataError(f"{folder} is not a report on a vocabulary: name another place with --report.")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        (partial / PAGE).write_text(report_page(classes, vocabulary=vocabulary, data=data))
        (partial / NUMBERS).write_text(json.dumps(report_numbers(classes, vocabulary=vocabulary, data=data), indent=1))
        coverage_picture(partial / PICTURE, classes, title=f"{vocabulary}, compared with {data}")
        shutil.rmtree(folder, ignore_errors=True)
        partial.replace(folder)
    except OSError as error:
        raise DataError(f"cannot write {folder} ({error}): make room or name another place with --report.") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def report_numbers(classes: tuple[ClassCoverage, ...], *, vocabulary: str, data: str) -> dict[str, object]:
    """Everything the page says, as plain JSON values in SI units."""
    return {"vocabulary": vocabulary, "data": data, "classes": {c.class_name: _numbers(c) for c in classes}}


def _numbers(coverage: ClassCoverage) -> dict[str, object]:
    def of(spread: Spread) -> dict[str, object]:
        return {"count": spread.count, "mean": spread.mean, "p95": spread.p95, "max": spread.max}

    return {
        "num_motions": coverage.single_m.count,
        "num_glitches": coverage.num_glitches,
        "num_tokens": coverage.num_tokens,
        "disk_radius_m": coverage.radius_m,
        "single_error_m": of(coverage.single_m),
        "rolling_error_m": of(coverage.rolling_m),
        "rolling_heading_error_rad": of(coverage.heading_rad),
        "fastest_token_mps": float(coverage.token_speed_mps.max()),
        "fastest_motion_mps": coverage.speed_mps.max,
        "asymmetry_m": coverage.asymmetry_m,
        "num_dead": int(coverage.is_dead.sum()),
        "num_spare": int(coverage.is_spare.sum()),
        "num_implausible": int(coverage.is_implausible.sum()),
        "token_0_stands_still": coverage.stands_still,
    }


ROWS = {
    "motions": lambda c: f"{c.single_m.count:,}",
    "tokens": lambda c: f"{c.num_tokens:,}",
    "radius of a disk [cm]": lambda c: "unknown" if c.radius_m is None else f"{100 * c.radius_m:.1f}",
    "error of single motions: mean · 95 % · max [cm]": lambda c: _centimetres(c.single_m),
    "error of whole tracks: mean · 95 % · max [cm]": lambda c: _centimetres(c.rolling_m),
    "heading of whole tracks: mean · 95 % [°]": lambda c: (
        f"{np.degrees(c.heading_rad.mean):.2f} · {np.degrees(c.heading_rad.p95):.2f}"
    ),
    "fastest token [m/s]": lambda c: f"{c.token_speed_mps.max():.1f}",
    "fastest motion [m/s]": lambda c: f"{c.speed_mps.max:.1f}",
    "left against right [cm]": lambda c: "the same" if c.asymmetry_m < 1e-5 else f"{100 * c.asymmetry_m:.1f}",
    "tokens no motion, nor its mirror image, falls on": lambda c: str(c.is_dead.sum()),
    "tokens for speeds the data lack": lambda c: str(c.is_spare.sum()),
    "implausible tokens": lambda c: str(c.is_implausible.sum()),
    "token 0 stands exactly still": lambda c: "yes" if c.stands_still else "no",
    "motions left out as glitches": lambda c: str(c.num_glitches),
}
"""What is said of each class."""

NOTES = """An error is the mean distance of the four corners of the class's box between record and token. *Single motions*: each half second
against the nearest token. *Whole tracks*: token after token, each from where the last one led, gaps and glitches of the record included.
*Left against right*: error of the token whose mirror image is worst represented. *Implausible*: a turn of more than 30° or a way
faster than the class moves within 0.1 s. *For speeds the data lack*: exactly straight ahead, and no motion falls on it.
"""


def report_page(classes: tuple[ClassCoverage, ...], *, vocabulary: str, data: str) -> str:
    """The report as Markdown."""
    head = ["| | " + " | ".join(c.class_name for c in classes) + " |", "|---|" + "---:|" * len(classes)]
    body = [f"| {name} | " + " | ".join(say(c) for c in classes) + " |" for name, say in ROWS.items()]
    table = "\n".join(head + body)
    return f"# A vocabulary\n\n{vocabulary}, compared with {data}.\n\n{table}\n\n{NOTES}\n![picture]({PICTURE})\n"


def _centimetres(spread: Spread) -> str:
    return f"{100 * spread.mean:.2f} · {100 * spread.p95:.2f} · {100 * spread.max:.1f}"
