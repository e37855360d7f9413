"""Make the models that ship with the package, and write their folders with cards of measured numbers.

    python benchmarks/shipped_models.py WORK [--start MODEL] [--ship FOLDER]

Every stage is a command, printed before it runs. All of them resume, so the same line goes on where it was stopped; two idle cores
take about three hours, half of it for evaluations. `--ship src/rlftsim/policies/shipped` replaces the models of a checkout.
"""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from safetensors.torch import load_file, save_file
from tyro.conf import Positional

import rlftsim as rs
from rlftsim.evaluation.columns import DRIFT_COLUMNS, TERMINAL_GOAL_COLUMNS, Column

NAMES = ("demo-base", "demo-tuned", "demo-goals")
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


def train(options: Options) -> dict[str, Path]:
    """Folders of the shipped models' runs, by name."""
    data, runs = options.work / "data", options.work / "runs"
    common, processes = ("--data", data), ("--processes", options.processes)
    run("synthesize", data, "--num-scenarios", options.num_scenarios, "--seed", 101, "--jobs", 2)
    epochs = () if options.epochs is None else ("--pretrain.epochs", options.epochs)
    if options.start is None:
        vocabulary = options.work / "vocabulary.safetensors"
        run("tokens", *common, "--recipe", "smart-demo-long", "--out", vocabulary)
        first = ("--vocabulary", vocabulary)
    else:
        first = ("--init-from", options.start, *(word for k, v in FURTHER.items() for word in (f"--{k}", v)))
    base, tuned, goals = (runs / name for name in NAMES)
    run("pretrain", "smart-demo-long", *common, "--out", base, *first, *epochs, *processes)
    run("finetune", "smart-demo-long", *common, "--model", base, "--out", tuned, *processes)
    trained = ("--method", "gcsl", "--goal", "indication", "--model", base, "--out", goals)
    run("finetune", "smart-demo", "--data", "synthetic", *trained, "--processes", 1)  # one scenario a batch
    return dict(zip(NAMES, (base, tuned, goals), strict=True))


def evaluate(options: Options, models: dict[str, Path]) -> dict[str, list[rs.Evaluation]]:
    """Evaluations by model: on the package's held-out scenarios, then on those of the data set."""
    found: dict[str, list[rs.Evaluation]] = {name: [] for name in models}
    jobs = 2 if options.processes == "auto" else options.processes
    for place, limit in (("synthetic", 40), (options.work / "data", options.limit)):
        out = options.work / "evaluations" / f"{Path(place).name}-{limit}"
        for name, model in models.items():
            words = ("--data", place, "--limit", limit, "--name", name, "--out", out, "--jobs", jobs)
            if name != "demo-goals":
                run("evaluate", model, *words)
            elif place == "synthetic":  # without goals it is the base
                run("evaluate", model, *words, "--goals", "logged")
            else:
                continue
            found[name].append(rs.Evaluation.read(out / f"{name}.parquet"))
    return found


def table(evaluations: list[rs.Evaluation], base: list[rs.Evaluation]) -> str:
    """Scores of a model on each data set, with its paired difference to the base."""
    head = " | ".join(f"{len(one)} scenarios | to demo-base" for one in evaluations)
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


def ship(options: Options, models: dict[str, Path], evaluations: dict[str, list[rs.Evaluation]]) -> Path:
    """Write the models with their cards, weights in float16; returns their folder."""
    ours = {
        "demo-base": "A SMART traffic model of 0.5 M weights, pre-trained on synthetic scenarios. Not fine-tuned.",
        "demo-tuned": "`demo-base` fine-tuned by MLOO: policy gradient on the realism meta-metric.",
        "demo-goals": "`demo-base` with a trained goal encoder (`indication`, with a logit bias). Without goals it decides as "
        "`demo-base`, to the last bit; below, all evaluated agents had their logged ends as goals.",
    }
    out = options.ship or options.work / "shipped"
    base = load_file(models["demo-base"] / "model" / "model.safetensors")
    for name, model in models.items():
        folder, source = out / name, model / "model"
        folder.mkdir(parents=True, exist_ok=True)
        weights = load_file(source / "model.safetensors")
        if name == "demo-goals":  # its other weights are those of the base
            save_file({k: v for k, v in weights.items() if k not in base}, folder / "goals.safetensors")
        else:
            save_file({k: v.half() for k, v in weights.items()}, folder / "model.safetensors")
        words = [f"--start {options.start}"] if options.start else []
        words += [f"--epochs {options.epochs:g}"] if options.epochs else []
        earlier = f", with the `{options.start}` of that time" if options.start else ""
        command = f"Made by `{' '.join(('python benchmarks/shipped_models.py WORK', *words))}`{earlier}"
        note = (
            "Held-out synthetic scenarios (CC0-1.0): those of the package, and others of new streets; 32 rollouts, temperature 1, metric 2025, "
            "before rounding to float16. Mean ± standard error; paired differences with their 95 % interval. "
            "Numbers on synthetic traffic say nothing about real traffic."
        )
        text = f"# {name}\n\n{ours[name]} Weights: CC0-1.0. {command}.\n\n{note}\n\n"
        (folder / "README.md").write_text(text + table(evaluations[name], evaluations["demo-base"]) + "\n")
    for file in ("config.json", "vocabulary.safetensors"):  # the others have the base's
        shutil.copy(models["demo-base"] / "model" / file, out / "demo-base")
    return out


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    models = train(options)
    print(ship(options, models, evaluate(options, models)))


if __name__ == "__main__":
    main()
