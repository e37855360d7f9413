"""Make the models that ship with the package, and write their folders with cards of measured numbers.

    python benchmarks/shipped_models.py WORK [--start MODEL] [--ship FOLDER]

Every stage is a command, printed before it runs. All of them resume, so the same line goes on where it was stopped; two idle cores
take about five hours, half of it for evaluations. `--ship src/rlftsim/policies/shipped` replaces the models of a checkout.
A model that comes out with the same bytes keeps its card: those of `demo-tuned` and `demo-fast` have the exam's scores besides.
"""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from safetensors.torch import load_file, save_file
from tyro.conf import Positional

import rlftsim as rs
from rlftsim.evaluation.columns import DRIFT_COLUMNS, TERMINAL_GOAL_COLUMNS, Column
from rlftsim.policies.calibrated.policy import calibration_table, read_calibration


@dataclass(frozen=True)
class Shipped:
    """A model that ships."""

    about: str
    base: str | None = None
    """Model it is fine-tuned from: only weights that differ from that one's are stored."""
    teacher: str | None = None
    """Model it is a student of, which the card compares it with; its weights are all stored."""
    options: tuple[str, ...] = ()
    """Further words of its evaluation."""
    is_quick: bool = True
    """Fast enough to be evaluated on the larger data set, too."""


MODELS = {
    "demo-base": Shipped("A SMART traffic model of 0.5 M weights, pre-trained on synthetic scenarios. Not fine-tuned."),
    "demo-tuned": Shipped(
        "`demo-base` fine-tuned by MLOO, policy gradient on the realism meta-metric (twice the mean of what three seeds "
        "changed), then calibrated with the seed of three that gained most on the package's scenarios.",
        "demo-base",
    ),
    "demo-fast": Shipped(
        "A student of `demo-tuned` with 63,200 weights, trained on the teacher's probabilities along rollouts of both "
        "(`rlftsim distill`), then fine-tuned by MLOO under constraints and calibrated. Four times as fast.",
        teacher="demo-tuned",
    ),
    "demo-goals": Shipped(
        "`demo-base` with a trained goal encoder (`indication`, with a logit bias). Without goals it decides as "
        "`demo-base`, to the last bit; below, all evaluated agents had their logged ends as goals.",
        "demo-base", options=("--goals", "logged"), is_quick=False,
    ),
    "trafficbots-base": Shipped(
        "A TrafficBots V1.5 model of 0.5 M weights, pre-trained on synthetic scenarios. Not fine-tuned.", is_quick=False
    ),
}  # fmt: skip
FURTHER = {
    "model.max-agent-neighbors": 24,
    "model.agent-radius-m": 60,
    "model.max-agent-map-neighbors": 64,
    "model.agent-map-radius-m": 50,
    "pretrain.learning-rate": 2.5e-3,
}
"""Settings for a model that is trained further: the neighborhoods of the recipe, and smaller steps."""
SHOWN = (
    "meta_metric", "kinematic", "interactive", "map_based", "min_average_displacement_error", "collision_rate",
    "unlogged_offroad_rate", "traffic_light_violation_rate", "speed_gap", "unlogged_stop_rate", "passing_miss_rate",
)  # fmt: skip
"""Columns of an evaluation that a card shows."""


@dataclass(frozen=True)
class Options:
    """Make the models that ship with the package."""

    work: Positional[Path]
    """Folder of scenarios, runs and evaluations."""
    start: str | None = None
    """Model to train further; None = fresh weights by the recipe."""
    num_scenarios: int = 2000
    """Synthetic scenarios, four fifths of them for training."""
    epochs: float | None = None
    """Of pre-training; None = the recipe's."""
    limit: int = 200
    """Held-out scenarios of that data set that models are evaluated on, beside the package's 40."""
    only: tuple[str, ...] = tuple(MODELS)
    """Models to make."""
    processes: str = "auto"
    """Processes that train, and jobs that evaluate."""
    ship: Path | None = None
    """Folder to write the models to; None = WORK/shipped."""


def run(*words: object) -> None:
    """Run a command of rlftsim, or end with its status."""
    text = [str(word) for word in words]
    print("rlftsim " + " ".join(text), flush=True)
    status = subprocess.run([sys.executable, "-m", "rlftsim", *text]).returncode
    if status:
        sys.exit(status)


def train(options: Options, name: str) -> Path:
    """Folder of a shipped model's run, after those that it starts from."""
    data, out = options.work / "data", options.work / "runs" / name
    run("synthesize", data, "--num-scenarios", options.num_scenarios, "--seed", 101, "--jobs", 2)
    base = MODELS[name].base
    common = ("--data", data, "--processes", options.processes)
    tuned = () if base is None else (*common, "--model", train(options, base))
    if name == "demo-base":
        epochs = () if options.epochs is None else ("--pretrain.epochs", options.epochs)
        if options.start is None:
            vocabulary = options.work / "vocabulary.safetensors"
            run("tokens", "--data", data, "--recipe", "smart-demo-long", "--out", vocabulary)
            first = ("--vocabulary", vocabulary)
        else:
            first = ("--init-from", options.start, *(word for k, v in FURTHER.items() for word in (f"--{k}", v)))
        run("pretrain", "smart-demo-long", *common, *first, *epochs, "--out", out)
    elif name == "demo-tuned":
        seeds = [options.work / "runs" / f"{name}-{seed}" for seed in range(3)]
        for seed, folder in enumerate(seeds):
            run("finetune", "smart-demo-long", *tuned, "--out", folder, "--finetune.seed", seed)
        start, mean = (options.work / "runs" / folder for folder in ("demo-base", f"{name}-mean"))
        shutil.rmtree(mean, ignore_errors=True)  # made anew in seconds, so nothing half written or older stays
        run("model", "average", *seeds, "--base", start, "--scale", 2, "--out", mean / "model")
        words = ("--data", "synthetic", "--processes", options.processes, "--model", mean, "--out", out)
        run("finetune", "smart-demo", "--method", "calibrate", *words, "--seed", 2)
    elif name == "demo-fast":
        student, tuned = (options.work / "runs" / f"{name}-{stage}" for stage in ("student", "weights"))
        words = ("--data", "synthetic", "--processes", 1)
        run("distill", train(options, "demo-tuned"), *words, "--epochs", 10, "--out", student)
        rewards = ("--method", "rlft", "--finetune.epochs", 2, "--finetune.validation.every", 0)
        run("finetune", "smart-demo-long", *rewards, *words, "--model", student, "--seed", 1, "--out", tuned)
        run("finetune", "smart-demo", "--method", "calibrate", *words, "--model", tuned, "--seed", 2, "--out", out)
    elif name == "demo-goals":  # one scenario a batch, so one process
        words = ("--data", "synthetic", "--processes", 1, "--method", "gcsl", "--goal", "indication", "--out", out)
        run("finetune", "smart-demo", *tuned, *words)
    else:
        run("pretrain", "trafficbots-demo", *common, "--pretrain.epochs", 1.5, "--out", out)
    return out


def evaluate(options: Options, name: str) -> list[rs.Evaluation]:
    """Evaluations of a model: on the package's held-out scenarios, then on those of the data set."""
    jobs = 2 if options.processes == "auto" else options.processes
    places = (("synthetic", 40), (options.work / "data", options.limit))
    found = []
    for place, limit in places if MODELS[name].is_quick else places[:1]:
        out = options.work / "evaluations" / f"{Path(place).name}-{limit}"
        words = ("--data", place, "--limit", limit, "--name", name, "--out", out, "--jobs", jobs)
        words += ("--rollouts-per-pass", 32)
        run("evaluate", options.work / "runs" / name, *words, *MODELS[name].options)
        found.append(rs.Evaluation.read(out / f"{name}.parquet"))
    return found


def table(evaluations: list[rs.Evaluation], base: list[rs.Evaluation]) -> str:
    """Scores of a model on each data set, with its paired difference to the base."""
    head = " | ".join(f"{len(one)} scenarios | to {base[0].name}" for one in evaluations)
    lines = [f"| | {head} |", "|---|" + "--:|--:|" * len(evaluations)]
    columns = {column.source: column for column in (*TERMINAL_GOAL_COLUMNS, *DRIFT_COLUMNS)}
    for column in map(columns.__getitem__, SHOWN):
        cells = []
        for one, reference in zip(evaluations, base[: len(evaluations)], strict=True):
            cells.append(column.cell(one.mean_and_error(column.source)))
            difference = rs.compare(reference, one)[column.source]
            gain, low, high = (_signed(column, one) for one in (difference.difference, *difference.interval))
            cells.append("" if one.name == reference.name else f"{gain} [{low}, {high}]")
        lines.append(f"| {column.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _signed(column: Column, number: float) -> str:
    return f"{'+' if number > 0 else ''}{column.text(number)}"


def read_files(folder: Path) -> dict[Path, bytes]:
    """Contents of a model's files, without the card."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "README.md"}


def ship(options: Options, name: str) -> Path:
    """Write a model with its card, weights in float16; returns its folder."""
    base, model = MODELS[name].base, options.work / "runs" / name / "model"
    evaluations = evaluate(options, name)
    reference = base or MODELS[name].teacher
    scores = table(evaluations, evaluations if reference is None else evaluate(options, reference))
    folder = (options.ship or options.work / "shipped") / name
    folder.mkdir(parents=True, exist_ok=True)
    card, files_before = folder / "README.md", read_files(folder)
    kept = card.read_text() if card.exists() else ""
    calibration = model / "calibration.json"
    inner = "base/model.safetensors" if calibration.exists() else "model.safetensors"  # weights of the network
    weights = {k: v.half() for k, v in load_file(model / inner).items()}
    if base is None:
        shutil.copytree(model, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.png"))
        save_file(weights, folder / inner)
    else:
        if calibration.exists():
            shutil.copy(calibration, folder)
        before = {
            k: v.half() for k, v in load_file(options.work / "runs" / base / "model" / "model.safetensors").items()
        }
        changed = {k: v for k, v in weights.items() if k not in before or not torch.equal(v, before[k])}
        save_file(changed, folder / "changes.safetensors")
    words = [f"--start {options.start}"] if options.start else []
    words += [f"--epochs {options.epochs:g}"] if options.epochs else []
    earlier = f", with the `{options.start}` of that time" if options.start else ""
    command = f"Made by `{' '.join(('python benchmarks/shipped_models.py WORK', *words))}`{earlier}"
    note = (
        "Held-out synthetic scenarios (CC0-1.0): those of the package, and others of new streets; 32 rollouts, temperature 1, metric 2025, "
        "before rounding to float16. Mean ± standard error; paired differences with their 95 % interval. "
        "Numbers on synthetic traffic say nothing about real traffic."
    )
    text = f"# {name}\n\n{MODELS[name].about} Weights: CC0-1.0. {command}.\n\n{note}\n\n"
    features = f"\n{calibration_table(read_calibration(calibration))}" if calibration.exists() else ""
    card.write_text(kept if kept and read_files(folder) == files_before else f"{text}{scores}\n{features}")
    return folder


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    for name in options.only:
        train(options, name)
        print(ship(options, name))


if __name__ == "__main__":
    main()
