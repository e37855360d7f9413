"""Runs of mutants, each in a forked child, and what came of them."""

import contextlib
import gc
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mutants import EVERYWHERE, HOSTILE, mutate_bytes, mutate_meaning
from mutated_formats import FORMATS, Format
from rlftsim.errors import RlftsimError

HANG_S = 10.0
"""Seconds of computing that no reader of a small file needs."""
PATIENCE_S = 90.0
"""Seconds of waiting, on a machine that has other work."""
MEMORY_BYTES = 2 << 30
"""Memory above that of the undamaged file."""
LONGEST_LINE = 1000
FINE = ("read", "refused")
FAULTS = ("traceback", "signal", "hang", "memory", "warning", "message")
FAMILIES = ("bytes", "meaning", "hostile")
_QUIET = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


@dataclass(frozen=True)
class Mutant:
    """A damaged file of a sample, and how it is made again."""

    format: str
    family: str
    seed: str
    """Seed and number, or the name of a hostile input."""
    file: str
    kind: str

    def change(self, data: bytes) -> bytes:
        """Bytes of the damaged file."""
        if self.family == "hostile":
            return {**EVERYWHERE, **HOSTILE[self.kind]}[self.seed](data)
        seed = f"{self.format} {self.seed}"
        return mutate_bytes(data, seed) if self.family == "bytes" else mutate_meaning(data, self.kind, seed)

    def __str__(self) -> str:
        return f"--format '{self.format}' --only {self.family} '{self.seed}' '{self.file}'"


@dataclass(frozen=True)
class Outcome:
    """What a child came to."""

    verdict: str
    """"read", "refused", or one of `FAULTS`."""
    text: str
    peak_bytes: int


class Sample:
    """A good sample of a format, read once in this process so that its imports are done.

    Args:
        name: Name of the format.
        folder: New folder for the sample and its damaged copies.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.format, self.folder = name, FORMATS[name], folder
        self.good = folder / "good"
        self.good.mkdir(parents=True)
        self._number = 0
        with _quiet():
            self.format.make(self.good)
            warm = self._copy("warm")
            self.format.read(warm)
        shutil.rmtree(warm)
        gc.collect()
        gc.freeze()  # a child's collections would copy every page of this process
        self.files = {
            str(path.relative_to(self.good)): kind
            for pattern, kind in self.format.files.items()
            for path in sorted(self.good.glob(pattern))
            if path.is_file()
        }
        assert self.files, f"{name}: no file of the sample is named {', '.join(self.format.files)}"
        self.undamaged = self.run(None, 1 << 40)
        assert self.undamaged.verdict == "read", f"{name}: the undamaged sample: {self.undamaged}"

    def mutants(self, seed: int, count: int) -> Iterator[Mutant]:
        """Mutants of each family, and the hostile inputs."""
        files = [*self.files.items()]
        for family in ("bytes", "meaning"):
            for number in range(count):
                yield Mutant(self.name, family, f"{seed}.{number}", *files[number % len(files)])
        by_kind = {kind: (file, kind) for file, kind in files}
        for file, kind in by_kind.values():
            for name in (*EVERYWHERE, *HOSTILE[kind]):
                yield Mutant(self.name, "hostile", name, file, kind)

    def try_mutant(self, mutant: Mutant) -> Outcome:
        """What comes of a mutant."""
        outcome = self.run(mutant, self.undamaged.peak_bytes + MEMORY_BYTES)
        # warnings that the good file causes, too, are none of the mutant
        return Outcome("read", "", 0) if outcome == self.undamaged else outcome

    def run(self, mutant: Mutant | None, most_bytes: int) -> Outcome:
        """What comes of reading a mutant, or the good sample, in a child."""
        self._number += 1
        place = self.folder / f"{self._number:06d}"
        ready, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ready)
            _read_in_child(self.format, lambda: self._damaged_copy(place, mutant), place, tell)
        os.close(tell)
        try:
            return _watch(child, ready, place.with_suffix(".json"), most_bytes)
        finally:
            os.close(ready)
            shutil.rmtree(place, ignore_errors=True)
            for path in self.folder.glob(f"{place.name}.*"):
                path.unlink()

    def _copy(self, name: str) -> Path:
        return Path(shutil.copytree(self.good, self.folder / name))

    def _damaged_copy(self, place: Path, mutant: Mutant | None) -> None:
        self._copy(place.name)
        if mutant is not None:
            path = place / mutant.file
            path.write_bytes(mutant.change(path.read_bytes()))


def _watch(child: int, ready: int, result: Path, most_bytes: int) -> Outcome:
    """Wait for a child, and end it where it hangs or takes too much memory."""
    os.read(ready, 1)  # the mutant is made; or the child has ended
    start_s, computed_s, peak, ended = time.monotonic(), _cpu_s(child), 0, None
    handle = os.pidfd_open(child)
    waiting = select.poll()
    waiting.register(handle, select.POLLIN)
    try:
        while not waiting.poll(20):
            peak = max(peak, _resident_bytes(child))
            if peak > most_bytes:
                ended = "memory"
            elif _cpu_s(child) - computed_s > HANG_S or time.monotonic() - start_s > PATIENCE_S:
                ended = "hang"
            if ended:
                os.kill(child, signal.SIGKILL)
                break
    finally:
        os.close(handle)
    _, status, usage = os.wait4(child, 0)
    peak = max(peak, usage.ru_maxrss * 1024)
    if ended == "hang":
        return Outcome("hang", f"{time.monotonic() - start_s:.0f} s", peak)
    if ended == "memory" or peak > most_bytes:
        return Outcome("memory", f"{peak / 1e9:.1f} GB", peak)
    if os.WIFSIGNALED(status):
        return Outcome("signal", signal.Signals(os.WTERMSIG(status)).name, peak)
    if not result.exists():
        return Outcome("signal", f"status {os.waitstatus_to_exitcode(status)} without a word", peak)
    verdict, text = json.loads(result.read_text())
    if verdict == "unmade":
        raise RuntimeError(f"a mutant could not be made: {text}")
    return Outcome(verdict, text, peak)


def _cpu_s(process: int) -> float:
    """Seconds that a process has computed."""
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _resident_bytes(process: int) -> int:
    with contextlib.suppress(OSError, IndexError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * resource.getpagesize()
    return 0


def _read_in_child(form: Format, prepare: Callable[[], object], place: Path, tell: int) -> None:
    """Read a sample and write what came of it beside it; never returns."""
    result = place.with_suffix(".json")
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        printed = place.with_suffix(".txt")
        output = os.open(printed, os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        try:
            prepare()
        except BaseException:
            result.write_text(json.dumps(["unmade", traceback.format_exc()[-3000:]]))
            os._exit(0)
        os.chdir(place)
        os.write(tell, b"r")
        verdict, text = _read(form, place)
        text = text.replace(str(place), "SAMPLE")
        sys.stdout.flush()
        sys.stderr.flush()
        lines = printed.read_text(errors="replace").split("\n")
        if verdict in FINE:
            bad = next((line for line in lines if not _is_showable(line)), None)
            native = next((line for line in lines if re.search(r"\bWarning\b|\[W\d+", line)), None)
            if bad is not None:
                verdict, text = "message", f"printed {len(bad)} characters: {bad.replace(str(place), 'SAMPLE')[:200]!r}"
            elif native is not None:
                verdict, text = "warning", native[:300]
        result.write_text(json.dumps([verdict, text[-3000:]]))
        os._exit(0)
    except BaseException:
        with contextlib.suppress(BaseException):
            result.write_text(json.dumps(["traceback", traceback.format_exc()[-3000:]]))
    os._exit(0)


def _read(form: Format, place: Path) -> tuple[str, str]:
    """Verdict and message of a reading."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for category in _QUIET:
            warnings.simplefilter("ignore", category)
        try:
            form.read(place)
            verdict, text = "read", ""
        except RlftsimError as error:
            text = str(error)
            verdict = "refused" if _is_showable(text) else "message"
            if verdict == "message":
                text = f"{len(text)} characters: {text.replace(str(place), 'SAMPLE')[:200]!r}"
        except BaseException as error:
            where = [f"{one.filename}:{one.lineno} {one.name}" for one in traceback.extract_tb(error.__traceback__)]
            ours = [one for one in where if "/rlftsim/" in one]
            last = f"{type(error).__name__}: {str(error)[:200]!r}"
            return "traceback", f"{last} in {ours[-1] if ours else where[-1]}"
    if seen:
        one = seen[0]
        return "warning", f"{one.category.__name__}: {str(one.message)[:200]!r} in {one.filename}:{one.lineno}"
    return verdict, text


def _is_showable(line: str) -> bool:
    """True for text that is one line of a terminal."""
    return len(line) <= LONGEST_LINE and not any(ord(sign) < 32 or 127 <= ord(sign) < 160 for sign in line)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield


@dataclass
class Row:
    """Outcomes of one family of mutants of a format."""

    format: str
    family: str
    counts: Counter[str]
    faults: list[tuple[Mutant, Outcome]]
    seconds: float = 0.0

    def cells(self) -> list[str]:
        """Cells of the table."""
        counts = [self.counts.total(), *(self.counts[name] for name in (*FINE, *FAULTS))]
        return [self.format, self.family, *map(str, counts)]


HEADINGS = ["format", "family", "mutants", *FINE, *FAULTS]


def run_format(name: str, folder: Path, seed: int, count: int, families: tuple[str, ...] = FAMILIES) -> list[Row]:
    """Rows of a format, one for each family.

    Args:
        name: Name of the format.
        folder: New folder for its files.
        seed: Seed of the mutants.
        count: Mutants of each family; hostile inputs come besides.
        families: Families that are tried.
    """
    try:
        sample = Sample(name, folder)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {str(error)[:200]!r} in {where.filename}:{where.lineno}"
        fault = (Mutant(name, "none", "the good sample", "", ""), Outcome("traceback", text, 0))
        return [Row(name, family, Counter(traceback=1), [fault]) for family in families[:1]]
    rows = {family: Row(name, family, Counter(), []) for family in families}
    for mutant in sample.mutants(seed, count):
        if mutant.family not in rows:
            continue
        start, row = time.monotonic(), rows[mutant.family]
        outcome = sample.try_mutant(mutant)
        row.counts[outcome.verdict] += 1
        row.seconds += time.monotonic() - start
        if outcome.verdict in FAULTS:
            row.faults.append((mutant, outcome))
    shutil.rmtree(folder, ignore_errors=True)
    return [*rows.values()]
