"""Settings and a film in TensorBoard, beside the metrics of a run."""

import io
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

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
