"""Trackers: programs that show a run while the run trains, called at the end of each update.

A tracker that fails, takes too long or is not installed costs a warning. Names are those in `TRACKERS`, or
`package.module:Class`. A package of your own adds a name with an entry point:

[project.entry-points."rlftsim.trackers"]
mine = "my_package:MyTracker"
"""

import io
import json
import os
import uuid
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from PIL import Image

from rlftsim.errors import ConfigError, DataError, shorten
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import write_text
from rlftsim.jobs.progress import log
from rlftsim.plugins import ExtensionPoint, import_object

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

COMPARED = ("validation/validation_rmm", "realism/rmm", "loss")
"""Metrics, by their names in TensorBoard, beside the hyper-parameters of runs."""


def write_settings(board: "SummaryWriter", settings: Mapping[str, Any]) -> None:
    """Add the settings of a run, as a table of text and as hyper-parameters to compare runs.

    Args:
        board: Open writer of the run's events.
        settings: Values by dotted name.
    """
    from torch.utils.tensorboard.summary import hparams  # not at the top: `--help` has no use for it

    values = {name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
              for name, value in settings.items()}  # fmt: skip
    rows = [f"| {name} | {str(value).replace('|', ' ')} |" for name, value in values.items()]
    board.add_text("settings", "\n".join(["| setting | value |", "|---|---|", *rows]), 0)
    # SummaryWriter.add_hparams would open a run of its own for them
    for summary in hparams(values, dict.fromkeys(COMPARED, 0.0)):
        board._get_file_writer().add_summary(summary)


def write_film(board: "SummaryWriter", frames: Sequence[np.ndarray], step: int, frame_s: float) -> None:
    """Add a film, which plays among the pictures.

    Args:
        board: Open writer of the run's events.
        frames: Pictures [height, width, 3] of equal size, uint8.
        step: Number of updates done.
        frame_s: Seconds that a frame stays.
    """
    from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue] (generated)

    film, (first, *later) = io.BytesIO(), [Image.fromarray(frame) for frame in frames]
    first.save(film, format="GIF", save_all=True, append_images=later, duration=round(1000 * frame_s), loop=0)
    image = Summary.Image(height=first.height, width=first.width, colorspace=3, encoded_image_string=film.getvalue())
    board._get_file_writer().add_summary(Summary(value=[Summary.Value(tag="film", image=image)]), step)


IDS = "trackers.json"
"""File of a run folder with the id of the run in each tracker."""
PROJECT = "rlftsim"
"""Project of the runs, unless the tracker's own environment variable names one."""
START_S, CALL_S = 60.0, 5.0
"""Longest time for beginning and ending a run, and for any other call."""
BOARD_GROUPS = {
    "reward": ("reward_",),
    "kl": ("kl", "beta"),
    "realism": ("rmm", "kinematic", "interactive", "map_based"),
    "alarm": ("alarm_",),
    "goal": ("goal_", "hindsight_"),
    "validation": ("validation_",),
    "time": ("seconds",),
}
"""Groups of metrics in TensorBoard: by the beginnings of their names."""
Status = Literal["finished", "stopped", "failed"]


class Tracker(Protocol):
    """Receives the metrics of a run. Made without arguments; all calls come from the same thread."""

    def start(self, run: str, config: dict[str, Any], resume: str | None) -> str | None:
        """Begin a run, or continue a run; returns an id that a later call gets as `resume`.

        Args:
            run: Folder of the run.
            config: Settings and inputs of the run by name, names with dots for groups.
            resume: Id that an earlier call returned for the run; None = a new run.
        """
        ...

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Add the metrics of an update.

        Args:
            values: Numbers by name, as in metrics.jsonl.
            step: Number of updates done. Updates behind the last checkpoint of a killed run come twice.
        """
        ...

    def artifact(self, path: str, kind: str) -> None:
        """Add a result of the run; not for trackers that keep no files.

        Args:
            path: Folder of the files, such as the trained model's.
            kind: Word for the content, "model".
        """
        ...

    def finish(self, status: Status) -> None:
        """End the run."""
        ...


class TensorBoardTracker(Tracker):
    """Events in the folder `tensorboard` of the run."""

    def start(self, run: str, config: dict[str, Any], resume: str | None) -> None:
        """The folder of the events and the settings are noted."""
        self._folder, self._config, self._board = os.path.join(run, "tensorboard"), config, None

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Scalars, in groups, behind the settings. Those of a killed run from this step on are hidden."""
        if self._board is None:
            from torch.utils.tensorboard import SummaryWriter

            is_new = not os.path.exists(self._folder)
            self._board = SummaryWriter(self._folder, purge_step=step)
            if is_new:
                write_settings(self._board, self._config)
        for name, value in values.items():
            self._board.add_scalar(board_tag(name), value, step)

    def finish(self, status: Status) -> None:
        """Pending events are written."""
        if self._board is not None:
            self._board.close()


class WandbTracker:
    """Weights & Biases; WANDB_MODE=offline keeps all in the folder of the run."""

    def start(self, run: str, config: dict[str, Any], resume: str | None) -> str:
        """The id of the run there."""
        import wandb  # pyright: ignore[reportMissingImports]

        project = os.environ.get("WANDB_PROJECT", PROJECT)
        self._run = wandb.init(
            project=project, name=Path(run).name, id=resume, config=config, dir=run, resume="allow" if resume else None
        )
        return self._run.id

    def log(self, values: Mapping[str, float], step: int) -> None:
        """A row of the history."""
        self._run.log(dict(values), step=step)

    def artifact(self, path: str, kind: str) -> None:
        """An artifact of the run."""
        import wandb  # pyright: ignore[reportMissingImports]

        artifact = wandb.Artifact(f"{kind}-{self._run.id}", kind)
        artifact.add_dir(path)
        self._run.log_artifact(artifact)

    def finish(self, status: Status) -> None:
        """The run ends, well or not."""
        self._run.finish(exit_code=int(status != "finished"))


class MlflowTracker:
    """MLflow, at the address that MLFLOW_TRACKING_URI names."""

    def start(self, run: str, config: dict[str, Any], resume: str | None) -> str:
        """The id of the run there."""
        import mlflow  # pyright: ignore[reportMissingImports]

        self._mlflow = mlflow
        mlflow.set_experiment(os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT))
        active = mlflow.start_run(run_id=resume, run_name=None if resume else Path(run).name)
        if resume is None:  # settings such as the number of processes may have other values in a resumed run
            mlflow.log_params(config)
        return active.info.run_id

    def log(self, values: Mapping[str, float], step: int) -> None:
        """A value of each metric."""
        self._mlflow.log_metrics(dict(values), step=step)

    def artifact(self, path: str, kind: str) -> None:
        """Files of the run."""
        self._mlflow.log_artifacts(path, kind)

    def finish(self, status: Status) -> None:
        """The run ends with a status of MLflow."""
        self._mlflow.end_run({"finished": "FINISHED", "stopped": "KILLED", "failed": "FAILED"}[status])


class TrackioTracker(Tracker):
    """Trackio: a file of SQLite on this machine, in the folder that TRACKIO_DIR names."""

    def start(self, run: str, config: dict[str, Any], resume: str | None) -> str:
        """The name of the run there, which differs from those of other runs."""
        import trackio  # pyright: ignore[reportMissingImports]

        name = resume or f"{Path(run).name}-{uuid.uuid4().hex[:8]}"
        self._run = trackio.init(
            project=os.environ.get("TRACKIO_PROJECT", PROJECT), name=name, config=config, resume="allow", embed=False,
            auto_log_gpu=False, auto_log_cpu=False,
        )  # fmt: skip
        return name

    def log(self, values: Mapping[str, float], step: int) -> None:
        """A row of the run."""
        self._run.log(dict(values), step=step)

    def finish(self, status: Status) -> None:
        """Pending rows are written."""
        self._run.finish()


TRACKERS: ExtensionPoint[Callable[[], Tracker]] = ExtensionPoint(
    "tracker",
    "rlftsim.trackers",
    {
        "tensorboard": "rlftsim.training.trackers:TensorBoardTracker",
        "wandb": "rlftsim.training.trackers:WandbTracker",
        "mlflow": "rlftsim.training.trackers:MlflowTracker",
        "trackio": "rlftsim.training.trackers:TrackioTracker",
    },
    use=lambda name: find_tracker(name),
    more="MODULE:CLASS",
)
"""Name -> class."""


def board_tag(name: str) -> str:
    """A metric's name in TensorBoard: the name in metrics.jsonl, behind the group if any."""
    groups = [group for group, beginnings in BOARD_GROUPS.items() if name.startswith(beginnings)]
    return "/".join([*groups, name])


def find_tracker(name: str) -> Callable[[], Tracker]:
    """Class of a tracker, by its name or as "package.module:Class".

    Raises:
        ConfigError: Unknown, not importable, or without a method of a tracker.
    """
    tracker = import_object("tracker", name) if ":" in name else TRACKERS.get(name)
    missing = [method for method in ("start", "log", "artifact", "finish") if not hasattr(tracker, method)]
    if missing:
        raise ConfigError(f"tracker {name!r} has no {', '.join(missing)}: see docs/trackers.md.")
    return tracker


class RunTrackers:
    """Trackers of a run, begun on construction. A tracker that fails raises no error here.

    Args:
        names: Names in `TRACKERS`, or "package.module:Class".
        folder: Folder of the run, which keeps the ids of the run in the trackers.
        config: Settings and inputs of the run, by name.
    """

    def __init__(self, names: Collection[str], folder: Path, config: dict[str, Any]) -> None:
        ids: dict[str, Any] = {}
        with suppress(DataError, FileNotFoundError):  # the trackers begin anew
            ids = read_json(folder / IDS, "remove it")
        self._threads = {name: _TrackerThread(name) for name in names}
        started = {
            name: thread.call(START_S, "start", str(folder), config, ids.get(name))
            for name, thread in self._threads.items()
        }
        new = {name: run_id for name, run_id in started.items() if run_id is not None}
        if not new.items() <= ids.items():
            write_text(folder / IDS, json.dumps(ids | new) + "\n")

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Hand over the metrics of an update.

        Args:
            values: Numbers by name, as in metrics.jsonl.
            step: Number of updates done.
        """
        for thread in self._threads.values():
            thread.call(CALL_S, "log", values, step)

    def finish(self, status: Status, model: Path | None = None) -> None:
        """End the run in all trackers.

        Args:
            status: Way in which the run ended.
            model: Folder of the trained policy; None = there is none.
        """
        for thread in self._threads.values():
            if model is not None:
                thread.call(START_S, "artifact", str(model), "model")
            thread.call(START_S, "finish", status)
            thread.end()
        self._threads = {}


class _TrackerThread:
    """Tracker in a thread, left out for good once a call fails or takes too long."""

    def __init__(self, name: str) -> None:
        self._name, self._is_lost = name, False
        self._calls: SimpleQueue[tuple[str, tuple[Any, ...], Future[Any]] | None] = SimpleQueue()
        Thread(target=self._work, name=f"tracker {name}", daemon=True).start()

    def _work(self) -> None:
        tracker = None
        while (call := self._calls.get()) is not None:
            method, arguments, answer = call
            try:
                tracker = tracker or find_tracker(self._name)()
                answer.set_result(getattr(tracker, method)(*arguments))
            except BaseException as error:
                answer.set_exception(error)

    def call(self, limit_s: float, method: str, *arguments: Any) -> Any:
        """Result of a method; None after a warning, and for a tracker that was left out before."""
        if self._is_lost:
            return None
        answer: Future[Any] = Future()
        self._calls.put((method, arguments, answer))
        try:
            return answer.result(limit_s)
        except TimeoutError:
            cause = f"{method} takes more than {limit_s:g} s"
        except ModuleNotFoundError as error:
            cause = f"{error}: pip install {PROJECT}[{self._name}]"
        except (Exception, SystemExit) as error:  # a library of others may fail in any way
            cause = f"{method} fails: {type(error).__name__}: {error}"
        self._is_lost = True
        log.warning(shorten(f"tracker {self._name} is left out, the run goes on: {cause}"))
        return None

    def end(self) -> None:
        """Let the thread end, once it is idle."""
        self._calls.put(None)
