"""Forecast of a training: the real command, stopped after a few updates, and again on the run's largest batch alone."""

import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64
from rich.table import Table

from rlftsim.errors import ConfigError, DataError, shorten
from rlftsim.jobs.progress import log
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.open import open_dataset
from rlftsim.training.data import scenarios_of_update
from rlftsim.training.parallel import balance_by_cost, scenario_costs
from rlftsim.training.registry import method_by_name
from rlftsim.training.run_folder import flatten, read_metrics, stored_settings
from rlftsim.verbs.finetune import choose_method

WARM_UP = 1
"""Updates that are not counted: they import, and fill caches."""
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Bytes that a container may use; "max" = no limit."""
SECONDS_BETWEEN_LOOKS = 0.05
MAX_LOOKED_AT = 100_000
"""Scenarios of a run, from its start, among which the largest batch is looked for."""
COUNTED = ("epochs", "batch_size", "num_scenarios", "held_back", "lengths")
"""Settings that the number of updates follows from, as far as a method has them."""


@dataclass(frozen=True)
class TrainingCommand:
    """A command line of a training that is to be forecast."""

    verb: Literal["finetune", "pretrain"]
    recipe: str
    model: str | None
    """Model to fine-tune, or to train further; None = fresh weights."""
    data: str
    vocabulary: str | None = None
    config: str | None = None
    """File of settings."""
    method: str | None = None
    """Method of fine-tuning; None = as the settings or the recipe say."""

    @cached_property
    def trainer(self) -> str:
        """Method of training."""
        words = self.write_words(self.data, Path())
        return "pretrain" if self.verb == "pretrain" else choose_method(recipe_by_name(self.recipe), words)

    def write_words(self, data: str | Path, out: Path, sizes: tuple[int, int] | None = None) -> list[str]:
        """Words of the command line.

        Args:
            data: Data set to train on.
            out: Folder of the run.
            sizes: Processes, which few scenarios would not have, and scenarios in memory at once; None = as the
                settings say.
        """
        words = [self.verb, self.recipe, "--data", str(data), "--out", str(out)]
        model_flag = "--model" if self.verb == "finetune" else "--init-from"
        flags = {"--vocabulary": self.vocabulary, "--config": self.config, "--method": self.method}
        for flag, value in {model_flag: self.model, **flags}.items():
            words += [flag, value] if value is not None else []
        if sizes is None:
            return words
        processes, micro_batch = sizes
        section = "finetune" if self.trainer == "rlft" else self.trainer
        return [*words, "--processes", str(processes), f"--{section}.micro-batch-size", str(micro_batch)]


@dataclass(frozen=True)
class MeasuredRun:
    """What a run took until it was stopped."""

    seconds: float
    """Of an update, mean over those behind the first."""
    peak_bytes: int
    """Largest memory of a process."""
    settings: dict[str, Any]


@dataclass(frozen=True)
class TrainingForecast:
    """Time and memory of a training on this machine."""

    num_updates: int
    seconds: float
    """Of an update."""
    num_measured: int
    processes: int
    micro_batch: int
    """Scenarios in memory at once with the given settings, over all processes."""
    peak_bytes: int
    """Of all processes, with the largest batch."""
    fitting_micro_batch: int
    """Largest one that fits, up to the batch; 0 = none."""
    available_bytes: int


def forecast_training(command: TrainingCommand, num_measured: int) -> TrainingForecast:
    """Forecast of a training.

    Args:
        command: Training to forecast.
        num_measured: Number of updates to measure.

    Raises:
        ConfigError, DataError: The command itself fails, with the same message; or it cannot fit into memory.
    """
    dataset = open_dataset(command.data, "training")
    available = find_memory()
    with tempfile.TemporaryDirectory(prefix="rlftsim-") as temporary:
        folder = Path(temporary)
        log.info(f"measure {num_measured} updates")
        run = measure_run(command.write_words(command.data, folder / "run"), folder / "run", WARM_UP + num_measured)
        batch_size, processes = run.settings["batch_size"], run.settings["device.processes"]
        micro_batch = min(run.settings["micro_batch_size"], batch_size)
        counted = {name: value for name, value in run.settings.items() if name in COUNTED}
        if "lengths" in counted:  # JSON has lists alone
            counted["lengths"] = tuple(counted["lengths"])
        num_updates = method_by_name(command.trainer).settings(**counted).num_updates(len(dataset))
        log.info("measure the largest batch")
        num_seen = min(num_updates * batch_size, MAX_LOOKED_AT)
        order = np.array(scenarios_of_update(0, num_seen, len(dataset), run.settings["seed"]))
        largest = write_largest(dataset, order, batch_size, processes, folder / "largest")
        peaks = {
            size: processes * measure_run(command.write_words(largest, out, (processes, size)), out, 1).peak_bytes
            for size, out in ((size, folder / f"micro-{size}") for size in dict.fromkeys((micro_batch, processes)))
        }
    fitting = find_fitting_micro_batch(peaks, available, batch_size)
    if not fitting:
        raise DataError(
            f"{command.verb} {command.recipe} cannot fit: at the least micro batch the largest batch needs "
            f"{peaks[processes] / 1e9:.1f} GB of this machine's {available / 1e9:.1f}: take fewer processes, or a "
            "smaller model."
        )
    peak, seconds = peaks[micro_batch], run.seconds
    return TrainingForecast(num_updates, seconds, num_measured, processes, micro_batch, peak, fitting, available)


def measure_run(words: list[str], out: Path, num_updates: int) -> MeasuredRun:
    """Run a training in a process of its own until some updates are done.

    Args:
        words: Command line without the name of the program.
        out: Folder of the run.
        num_updates: Number of updates to wait for; fewer where the run is shorter.

    Raises:
        ConfigError: The command fails, with its message.
        DataError: The process was killed, as by a machine that is out of memory.
    """
    with tempfile.TemporaryFile("w+") as errors:
        command = [sys.executable, "-m", "rlftsim", *words]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        is_stopped, moments = False, []
        try:
            while True:
                done, status, usage = os.wait4(process.pid, os.WNOHANG)
                num_done = len(read_metrics(out)) if out.exists() else 0
                moments += [time.monotonic()] * (num_done - len(moments))
                if done:
                    break
                if num_done >= num_updates and not is_stopped:
                    is_stopped = True
                    process.send_signal(signal.SIGTERM)
                time.sleep(SECONDS_BETWEEN_LOOKS)
        except BaseException:  # stopped: else the training would go on by itself
            process.terminate()
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode == -signal.SIGKILL:
            raise DataError(f"{' '.join(words)}: was killed, as where memory ends: take a smaller micro batch.")
        if process.returncode and not is_stopped:
            errors.seek(0)
            lines = errors.read().strip().splitlines() or ["no message"]
            raise ConfigError(f"{words[0]} cannot be forecast: {shorten(lines[-1].removeprefix('rlftsim: '))}")
    moments = moments[:num_updates]
    seconds = (moments[-1] - moments[0]) / (len(moments) - 1) if len(moments) > 1 else math.nan
    return MeasuredRun(seconds, usage.ru_maxrss * 1024, flatten(stored_settings(out)))


def write_largest(
    dataset: ScenarioDataset, order: Int64[np.ndarray, "n"], batch_size: int, processes: int, folder: Path
) -> Path:
    """Write a data set of the scenarios of the largest batch, all of the split training. Returns its folder.

    In the largest, a process has most agents, padding included: its scenarios times the largest of these.

    Args:
        dataset: Scenarios to choose from.
        order: Positions of the scenarios in the order of the run, batch after batch.
        batch_size: Scenarios of a batch; at least two are written, which a calibration needs.
        processes: Number of processes that share a batch, each with about the same cost.
        folder: Folder to write.
    """
    size, costs, agents = max(batch_size, 2), scenario_costs(dataset), dataset.num_agents

    def padded_agents(batch: Int64[np.ndarray, "size"]) -> int:
        groups = [batch[group] for group in balance_by_cost(costs[batch], processes) if group]
        return max(len(group) * int(agents[group].max()) for group in groups)

    largest = max(np.resize(order, (max(len(order) // size, 1), size)), key=padded_agents)
    positions = dict.fromkeys(largest.tolist())  # a small data set is seen twice in a batch
    write_dataset((dataset[position] for position in positions), folder, split="training")
    return folder


def find_fitting_micro_batch(peaks: dict[int, int], available: int, most: int) -> int:
    """Largest micro batch whose memory fits, on the line through two measurements; 0 where the smaller does not fit.

    Args:
        peaks: Peak memory in bytes, by micro batch: one measurement or two.
        available: Memory of the machine, in bytes.
        most: Scenarios of an update, the largest micro batch that makes sense.
    """
    smaller, larger = min(peaks), max(peaks)
    if peaks[smaller] > available:
        return 0
    slope = (peaks[larger] - peaks[smaller]) / (larger - smaller) if larger > smaller else 0.0
    if slope <= 0:
        return most if peaks[larger] <= available else smaller
    return max(min(math.floor(smaller + (available - peaks[smaller]) / slope), most), smaller)


def find_memory() -> int:
    """Memory of this machine in bytes, within the limit of the container."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = CGROUP_LIMIT.read_text().strip() if CGROUP_LIMIT.is_file() else "max"
    return min(memory, int(limit)) if limit.isdecimal() else memory


def training_table(command: TrainingCommand, forecast: TrainingForecast) -> Table:
    """Updates, time, memory and a micro batch that fits.

    Args:
        command: Training that was forecast.
        forecast: Time and memory.
    """
    table = Table(
        title=f"{command.verb} {command.recipe} on this machine, {forecast.processes} processes",
        caption="without validations and the start; a GPU's own memory is not measured",
        show_header=False,
    )  # fmt: skip
    table.add_row("updates", str(forecast.num_updates))
    if math.isnan(forecast.seconds):
        table.add_row("time", f"not measured: it takes {WARM_UP + 1} updates, this run has {forecast.num_updates}")
    else:
        total = forecast.num_updates * forecast.seconds
        table.add_row("an update", f"{forecast.seconds:.3g} s (mean of {forecast.num_measured})")
        table.add_row("in all", f"{total:.0f} s" if total < 120 else f"{total / 60:.0f} min")
    needed, available = (value / 1e9 for value in (forecast.peak_bytes, forecast.available_bytes))
    fits = "" if needed <= available else ", which does not fit"
    table.add_row("peak memory", f"{needed:.1f} GB of {available:.1f} GB, with the largest batch{fits}")
    table.add_row("micro batch", f"{forecast.micro_batch} now, up to {forecast.fitting_micro_batch} fit")
    return table
