"""The speed table: training, rollouts, metric, demo and evaluation, beside an older version and the public code.

    python benchmarks/speed.py WORK --shared ../shared --old CHECKOUT --womd FOLDER \\
        --catk CHECKOUT --catk-python VENV/bin/python --official VENV/bin/python \\
        --out WORK/speed.md

Prints Markdown, each row when it is done; `--rows finetune rollouts` picks some. Results are kept in WORK, so the same
command continues where it was stopped. What is not there (an older version, the public code, real scenarios, a GPU)
leaves cells or rows empty.

Every number comes from a process of its own with one thread (`speed_jobs.py`, `speed_public.py`). The processes of a
row take turns, one repetition each. The older version is a git worktree. FOLDER holds real scenarios as WOMD tfrecords
in training/ and validation/. The public code (NVlabs/catk) and the official evaluator run in environments of their own.
"""

import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Literal, get_args

import tyro
from speed_jobs import NUM_EVALUATED, Job, Numbers  # beside this file
from tyro.conf import Positional

HERE = Path(__file__).resolve().parent
SIDES = ("public", "old", "new")
Side = Literal["public", "old", "new"]
Samples = dict[str, list[Numbers]]
"""Repetitions of each side."""
Row = Literal["check", "finetune", "pretrain", "catk", "rollouts", "gap", "metric", "demo", "evaluation", "gpu"]
FORMATS = {
    "seconds": ("CPU s", "{:.2f}"),
    "faults": ("page faults", "{:,.0f}"),
    "peak_mib": ("peak MiB", "{:,.0f}"),
    "score_gap": ("log-probability, sampled against scored, largest difference", "{:.1e}"),
    "meta_metric": ("RMM", "{:.3f}"),
    "search_share": ("share of time in the stand-in search", "{:.1%}"),
    "inputs_equal": ("preprocessed scenario equals the golden one (1 = yes)", "{:.0f}"),
    "greedy_tokens_equal": ("greedy tokens equal the golden ones (1 = yes)", "{:.0f}"),
    "logits": ("logits against the golden ones, largest difference", "{:.1e}"),
}
"""Label and format of a quantity; others are CPU seconds of the part they name."""
NO_RATIO = ("score_gap", "meta_metric")
NEEDS_TINY = {"check", "pretrain", "catk", "rollouts", "gap", "evaluation", "gpu"}


@dataclass(frozen=True)
class Options:
    """The speed table."""

    work: Positional[Path]
    """Folder for inputs and results."""
    shared: Path = Path("../shared")
    """Folder of the official material."""
    old: Path | None = None
    """Checkout of an older version."""
    womd: Path | None = None
    """Folder with real scenarios, as WOMD tfrecords in training/ and validation/."""
    catk: Path | None = None
    """Checkout of the public code."""
    catk_python: Path | None = None
    """Python of the environment it runs in."""
    official: Path | None = None
    """Python of an environment with the official evaluator."""
    rows: tuple[Row, ...] = ()
    """Rows to measure; none = all."""
    out: Path | None = None
    """Markdown file for the table."""
    repeats: int = 3
    num_rollouts: int = 32
    public_rollouts: int = 3
    """The public code makes rollouts one after the other: so many are timed, for all of them."""
    full_demo: bool = False
    """The whole demo, once, instead of its smallest size."""
    dry_run: bool = False
    """Rows of the GPU on the CPU, a scenario and two rollouts each, so that a lent machine loses no time on a mistake."""

    def checkout(self, side: Side) -> Path:
        return self.old if side == "old" and self.old else HERE.parent

    def sides(self, wanted: tuple[str, ...]) -> list[Side]:
        """Of the wanted sides those that are there."""
        there = {"public": self.catk and self.catk_python, "old": self.old, "new": True}
        return [side for side in SIDES if side in wanted and there[side]]

    @property
    def inputs(self) -> Path:
        return self.work.resolve() / "inputs"


# ---- processes -----------------------------------------------------------------------------------------------------------


def environment(options: Options, side: Side) -> dict[str, str]:
    threads = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    return os.environ | threads | {"PYTHONPATH": str(options.checkout(side) / "src")}


def job_command(options: Options, side: Side, job: Job) -> list[str]:
    """Command line of a job's process."""
    job = replace(job, inputs=str(options.inputs), shared=job.shared or str(options.shared.resolve()))
    if options.dry_run and job.device == "cuda":
        job = replace(job, device="cpu", scenarios=job.scenarios[:1], num_rollouts=2, batch_size=1, warms_up=False)
    if side != "public":
        return [sys.executable, str(HERE / "speed_jobs.py"), job.write()]
    job = replace(job, checkout=str(options.catk), timed_rollouts=options.public_rollouts)
    return [str(options.catk_python), str(HERE / "speed_public.py"), job.write()]


def rlftsim(*words: object) -> list[str]:
    return [sys.executable, "-m", "rlftsim", *map(str, words)]


def run_job(options: Options, side: Side, job: Job) -> None:
    subprocess.run(
        job_command(options, side, job), check=True, env=environment(options, side), stdout=subprocess.DEVNULL
    )


class Worker:
    """A process that repeats its job on command."""

    def __init__(self, options: Options, side: Side, job: Job):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(job_command(options, side, job), env=environment(options, side), **pipes)
        self._answer()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.stdin.close()
        self.process.wait()

    def repeat(self) -> Numbers:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Numbers:
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f"this process failed, see above: {' '.join(self.process.args)}")
        return json.loads(line)


def cpu_of_command(command: list[str], env: dict[str, str]) -> Numbers:
    """CPU seconds and peak memory of a command, start-up included."""
    process = subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL)
    _, process.returncode, usage = os.wait4(process.pid, 0)
    if process.returncode:
        sys.exit(f"this command failed, see above: {' '.join(command)}")
    return {"seconds": usage.ru_utime + usage.ru_stime, "peak_mib": usage.ru_maxrss / 1024}


# ---- what is measured ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measurement:
    """A line of the table, or a few: one piece of work on several sides."""

    row: Row
    name: str
    measure: Callable[[Options], Samples]
    shown: tuple[str, ...] = ("seconds", "peak_mib", "search_share")
    needs: Literal["", "real scenarios", "GPU", "public code"] = ""
    is_variant: bool = False
    """A dry run leaves it out: it differs from another row in size or precision alone."""

    def missing(self, options: Options) -> str:
        """Why it cannot be measured."""
        there = {
            "": lambda: True,
            "real scenarios": lambda: options.womd,
            "public code": lambda: options.sides(("public",)),
            "GPU": lambda: options.dry_run or has_gpu(),
        }
        return "" if there[self.needs]() else f"no {self.needs}"


@functools.cache
def has_gpu() -> bool:
    # In a process of its own: this one has no use for torch.
    command = [sys.executable, "-c", "import torch; print(torch.cuda.is_available())"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip() == "True"


def take_turns(job: Job, sides: tuple[str, ...] = SIDES, repeats: int | None = None) -> Callable[[Options], Samples]:
    """Measures a job on all sides, one repetition each in turn."""

    def measure(options: Options) -> Samples:
        resized = replace(job, num_rollouts=options.num_rollouts)
        with ExitStack() as stack:
            workers = {s: stack.enter_context(Worker(options, s, resized)) for s in options.sides(sides)}
            turns = [{s: w.repeat() for s, w in workers.items()} for _ in range(repeats or options.repeats)]
        return {side: [turn[side] for turn in turns] for side in workers}

    return measure


def metric(options: Options) -> Samples:
    """The metric of one scenario, beside one run of the official evaluator."""
    prefix = "bada"
    samples = take_turns(Job("metric", scenarios=(prefix,)), ("old", "new"))(options)
    if options.official:
        rollouts = options.shared / "golden" / "rmm" / "rollouts" / f"{prefix}_messy.npz"
        samples["public"] = [official_evaluator(options, options.shared / "data" / "womd", rollouts)]
    return samples


def official_evaluator(options: Options, scenarios: Path, rollouts: Path) -> Numbers:
    """The official evaluator's own CPU seconds, and those of its whole process."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.json"
        script = options.shared / "tools" / "official_rmm" / "evaluate.py"
        words = ["--scenarios", scenarios, "--rollouts", rollouts, "--configs", "2025", "--threads", "1", "--out", out]
        process = cpu_of_command([str(word) for word in (options.official, script, *words)], dict(os.environ))
        cases = json.loads(out.read_text())["cases"]
    scored_s = sum(c["timing_s"]["cpu_features"] + c["timing_s"]["scoring"]["2025"] for c in cases)
    meta_metric = statistics.mean(c["configs"]["2025"]["metrics"]["metametric"] for c in cases)
    own = {"seconds": scored_s, "process_s": process["seconds"], "meta_metric": meta_metric}
    return own | {"peak_mib": process["peak_mib"]}


def evaluation(options: Options) -> Samples:
    """A whole evaluation of real scenarios, from prepared files to the scores."""
    import pyarrow.parquet

    samples: Samples = {}
    for side in options.sides(("old", "new")):
        with tempfile.TemporaryDirectory() as out:
            size = ("--limit", NUM_EVALUATED, "--num-rollouts", options.num_rollouts, "--top-k", 48, "--jobs", 1)
            files = (options.inputs / "tiny", "--data", options.inputs / "real", "--out", out, "--name", "tiny")
            numbers = cpu_of_command(rlftsim("evaluate", *files, *size), environment(options, side))
            scores = pyarrow.parquet.read_table(Path(out) / "tiny.parquet")["meta_metric"].to_pylist()
        samples[side] = [numbers | {"meta_metric": statistics.mean(scores)}]
    if options.sides(("public",)) and options.official:
        job = Job("evaluate", num_rollouts=options.num_rollouts)
        simulation = cpu_of_command(job_command(options, "public", job), environment(options, "public"))
        scoring = official_evaluator(options, options.womd / "validation", options.inputs / "evaluated")
        parts = {"simulation": simulation["seconds"], "scoring": scoring["process_s"]}
        numbers = {"seconds": sum(parts.values()), "meta_metric": scoring["meta_metric"], **parts}
        samples["public"] = [numbers | {"peak_mib": max(simulation["peak_mib"], scoring["peak_mib"])}]
    return samples


def demo(options: Options) -> Samples:
    """CPU seconds of the slowest process in each stage of `rlftsim demo`."""
    sides = options.sides(("old", "new"))
    turns = [{s: time_demo(options, s) for s in sides} for _ in range(1 if options.full_demo else options.repeats)]
    return {side: [turn[side] for turn in turns] for side in sides}


def time_demo(options: Options, side: Side) -> Numbers:
    with tempfile.TemporaryDirectory() as out:
        command = rlftsim("demo", "--out", out, *([] if options.full_demo else ["--quick"]))
        process = subprocess.Popen(
            command, env=environment(options, side), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        used: dict[int, float] = {}  # CPU seconds by process, also of those that have ended
        threading.Thread(target=watch_session, args=(process, used), daemon=True).start()
        stages, before, name = {}, {}, "start"
        for line in (*process.stderr, "0  end"):
            stage = re.match(r"\d+  ([\w-]+)", line)  # the rule above each stage: "2  pre-training: ..."
            if stage:
                now = dict(used)
                stages[name] = max((s - before.get(pid, 0.0) for pid, s in now.items()), default=0.0)
                before, name = now, stage[1]
        if process.wait():
            sys.exit(f"the demo failed: {' '.join(command)}")
    return {**stages, "seconds": sum(stages.values())}


def watch_session(process: subprocess.Popen, used: dict[int, float]) -> None:
    """Keep the CPU seconds of all processes of a session up to date until its first one ends."""
    tick = os.sysconf("SC_CLK_TCK")
    while process.poll() is None:
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                words = path.read_text().rpartition(")")[2].split()
            except OSError:
                continue  # ended in between
            if int(words[3]) == process.pid:
                used[int(path.parent.name)] = (int(words[11]) + int(words[12])) / tick
        time.sleep(0.1)


TUNED = ("seconds", "faults", "peak_mib", "score_gap")
STAGES = ("start", "vocabulary", "pre-training", "fine-tuning", "evaluation", "report", "seconds")
EVALUATED = ("seconds", "simulation", "scoring", "peak_mib", "meta_metric")
CHECKED = ("inputs_equal", "greedy_tokens_equal", "logits")
OURS = ("old", "new")
# fmt: off
MEASUREMENTS = (
    Measurement("check", "the public code as it is timed, tiny, A", take_turns(Job("check", scenarios=("A",)), ("public",), 1), CHECKED, "public code"),
    Measurement("finetune", "fine-tuning update, demo, 4 × 8, synthetic", take_turns(Job("finetune", data="synthetic"), OURS), TUNED),
    Measurement("finetune", "fine-tuning update, demo, 4 × 8, real", take_turns(Job("finetune", data="real"), OURS), TUNED, "real scenarios"),
    Measurement("pretrain", "pre-training update, tiny, A", take_turns(Job("pretrain", scenarios=("A",)))),
    Measurement("pretrain", "pre-training update, tiny, A + B", take_turns(Job("pretrain", scenarios=("A", "B")))),
    Measurement("catk", "CAT-K update, tiny, A", take_turns(Job("catk", scenarios=("A",)))),
    Measurement("rollouts", "rollouts, tiny, A, random weights", take_turns(Job("rollouts", scenarios=("A",)))),
    Measurement("rollouts", "rollouts, tiny, B, random weights", take_turns(Job("rollouts", scenarios=("B",)))),
    Measurement("rollouts", "rollouts, tiny, A, held as logged", take_turns(Job("rollouts", scenarios=("A",), held=True))),
    Measurement("rollouts", "rollouts, tiny, B, held as logged", take_turns(Job("rollouts", scenarios=("B",), held=True))),
    # All tokens: with 48, rounding decides between the 48th and the 49th, and the one left out has no probability.
    Measurement("gap", "rollouts, tiny, A and B", take_turns(Job("gap", scenarios=("A", "B"), top_k=None), OURS, 1), ("score_gap",)),
    Measurement("metric", "metric, 32 rollouts of bada; official evaluator", metric),
    Measurement("demo", "demo, slowest process of each stage", demo, STAGES),
    Measurement("evaluation", f"evaluation of {NUM_EVALUATED} real scenarios, tiny; public code and official evaluator", evaluation, EVALUATED, "real scenarios"),
    Measurement("gpu", "metric, 16 scenarios", take_turns(Job("metric", scenarios=("bada", "637f") * 8, device="cuda"), OURS), needs="GPU"),
    *(
        Measurement(
            "gpu", f"{name}, {precision}", take_turns(replace(job, device="cuda", precision=precision)), needs="GPU",
            is_variant=precision == "32-true" or len(job.scenarios) == 1,
        )
        for name, job in (
            ("rollouts, tiny, A", Job("rollouts", scenarios=("A",))),
            ("rollouts, tiny, 16 scenarios", Job("rollouts", scenarios=("A", "B") * 8)),
            ("pre-training update, tiny, 16 scenarios", Job("pretrain", scenarios=("A", "B") * 8)),
            ("CAT-K update, tiny, 16 scenarios", Job("catk", scenarios=("A", "B") * 8)),
            ("fine-tuning update, tiny, 4 × 8", Job("finetune", data="synthetic", model="tiny")),
        )
        for precision in ("32-true", "bf16-mixed")
    ),
)
# fmt: on


def prepare(options: Options, rows: Sequence[Row]) -> None:
    """Make the inputs of these rows, by the older version, whose files the newer one reads."""
    side: Side = "old" if options.old else "new"

    def once(name: str, make: Callable[[], None]) -> None:
        if not (options.inputs / f"{name}.done").exists():
            print(f"preparing {name}", file=sys.stderr)
            make()
            (options.inputs / f"{name}.done").touch()

    def convert() -> None:
        for split in ("training", "validation"):
            words = rlftsim("convert", options.womd / split, options.inputs / "real")
            subprocess.run(words, check=True, env=environment(options, side), stdout=subprocess.DEVNULL)

    options.inputs.mkdir(parents=True, exist_ok=True)
    if NEEDS_TINY & {*rows}:
        once("tiny", lambda: run_job(options, side, Job("prepare_tiny")))
    if options.womd and {"finetune", "evaluation"} & {*rows}:
        once("real", convert)
    if "finetune" in rows:
        once("base", lambda: run_job(options, side, Job("prepare_base")))
    if options.womd and "evaluation" in rows:
        records = Job("prepare_evaluated", shared=str(options.womd / "validation"))
        once("evaluated_new", lambda: run_job(options, "new", records))
        if options.sides(("public",)):  # from the records of the line above
            once("evaluated_public", lambda: run_job(options, "public", records))


# ---- the report ----------------------------------------------------------------------------------------------------------

HEADER = "| measurement | | public | old | new | old ÷ new | public ÷ new |\n|---|---|--:|--:|--:|--:|--:|"
NOTES = f"""- Median (least to greatest) of the repetitions. The processes of a row take turns, one repetition each, and a ratio
  is that of a turn, again median (least to greatest).
- CPU time: user and system, one thread, after a repetition that is not counted. Page faults are those of a repetition,
  memory is the peak of the process. Each repetition gets its scenarios as from a file, so tokens and the scenario's own
  part of the metric are computed anew.
- `A` is scenario 637f20cafde22ff8 (50 agents), `B` is ee519cf571686d19 (84 agents). SMART-tiny has the weights of the
  golden numbers, which are random, so its agents never stand still. "Held as logged": on all sides an agent keeps its
  pose in each decision in whose half second it moves less than 5 cm in the log.
- The public code makes rollouts one after the other and encodes the map anew in each; a few are timed and all are
  extrapolated. Where torch-cluster is not installed, an exact search stands in for it. The row "as it is timed" compares
  it with its golden numbers.
- The fine-tuning updates begin with the demo's base model, also on real scenarios; the scenarios are the first four of
  the training split.
- Demo: CPU seconds of the process that used most in each stage, start-up included, and their sum.
- Evaluation: from prepared files (a data set, pickles) to the scores, the CPU time of whole processes, start-up
  included; {NUM_EVALUATED} scenarios, one run.
"""


def describe_machine() -> str:
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    model = names[0].partition(":")[2].strip() if names else platform.processor()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    python = f"Python {platform.python_version()}, torch {importlib.metadata.version('torch')}"
    return f"{os.cpu_count()} cores of {model}, {memory:.0f} GiB, {platform.system()}, {python}"


def describe_versions(options: Options, revision: str) -> str:
    """Commits ("HEAD") or hashes of the code ("HEAD:src") of all sides, with those of changes that are not committed."""
    found = []
    for name, checkout in (("new", HERE.parent), ("old", options.old), ("public", options.catk)):
        if checkout:
            git = ["git", "-C", str(checkout)]
            head = subprocess.run([*git, "rev-parse", "--short", revision], capture_output=True, text=True).stdout
            changes = subprocess.run([*git, "diff", "HEAD", "--", "src"], capture_output=True).stdout
            changed = f" with changes {hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
            found.append(f"{name} {head.strip()}{changed}")
    return ", ".join(found)


def describe_size(options: Options) -> str:
    rollouts = f"{options.num_rollouts} rollouts (of the public code {options.public_rollouts} are timed)"
    dry_run = "dry run, whose numbers of the GPU are the CPU's, " if options.dry_run else ""
    return f"{dry_run}{options.repeats} repetitions, {rollouts}, {'the whole demo' if options.full_demo else 'demo --quick'}"


def lines_of(measurement: Measurement, samples: Samples) -> str:
    """Rows of the table: a line for each quantity."""
    lines = []
    for key in measurement.shown:
        if not any(key in numbers for taken in samples.values() for numbers in taken):
            continue
        values = {side: [numbers[key] for numbers in taken if key in numbers] for side, taken in samples.items()}
        label, form = FORMATS.get(key, (f"CPU s, {key}", "{:.2f}"))
        if key == "seconds" and measurement.needs == "GPU":
            label, form = "wall s on the GPU", "{:.3f}"
        cells = [spread(values.get(side, []), form) for side in SIDES]
        for side in ("old", "public"):
            pairs = zip(values.get(side, []), values.get("new", []))
            ratios = [] if key in NO_RATIO else [theirs / ours for theirs, ours in pairs if ours]
            cells.append(spread(ratios, "{:.2f}"))
        lines.append(f"| {'' if lines else measurement.name} | {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def spread(values: list[float], form: str) -> str:
    if not values:
        return ""
    least, greatest = form.format(min(values)), form.format(max(values))
    return form.format(statistics.median(values)) + (f" ({least} to {greatest})" if least != greatest else "")


class Results:
    """Samples by measurement, kept in a file for each machine, code and size."""

    def __init__(self, options: Options):
        self.path = options.work / "results.json"
        self.key = f"{describe_machine()}; {describe_versions(options, 'HEAD:src')}; {describe_size(options)}"
        self.kept: dict[str, dict[str, Samples]] = json.loads(self.path.read_text()) if self.path.exists() else {}

    def of(self, measurement: Measurement, options: Options) -> Samples:
        samples = self.kept.setdefault(self.key, {})
        if measurement.name not in samples:
            samples[measurement.name] = measurement.measure(options)
            self.path.write_text(json.dumps(self.kept, indent=1) + "\n")
        return samples[measurement.name]


def main(options: Options) -> None:
    rows = options.rows or get_args(Row)
    prepare(options, rows)
    results = Results(options)
    versions, load = describe_versions(options, "HEAD"), f"load at the beginning {os.getloadavg()[0]:.1f}"
    setup = f"{describe_machine()}, {load}. Commits: {versions}. {describe_size(options)}.".replace(". ", ".\n")
    table = [f"# Speed, {date.today()}\n\n{setup}\n\n{NOTES}\n{HEADER}"]
    print(table[0], flush=True)
    for measurement in MEASUREMENTS:
        if measurement.row in rows and not (options.dry_run and measurement.is_variant):
            missing = measurement.missing(options)
            empty = f"| {measurement.name} | {missing} | | | | | |"
            table.append(empty if missing else lines_of(measurement, results.of(measurement, options)))
            print(table[-1], flush=True)
            if options.out:
                options.out.write_text("\n".join(table) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
