"""What each feature of a calibration earns, as a picture in the model folder."""

from pathlib import Path

from rlftsim.policies.calibrated.policy import CALIBRATION, read_calibration
from rlftsim.viewer.figure import Interval, draw_intervals, save_figure


def write_calibration_picture(model: Path) -> Path | None:
    """Draw `calibration.png` into a model folder: the RMM that each feature earns, with its 95 % interval.

    Args:
        model: Folder of a calibrated policy.

    Returns:
        The picture; None if the folder holds no calibration.
    """
    path = model / CALIBRATION
    if not path.exists():
        return None
    rows = sorted(read_calibration(path)["features"], key=lambda row: -row["rmm"])
    intervals = []
    for row in rows:
        half = 1.96 * abs(row["rmm"] / row["t"]) if row["t"] else 0.0
        intervals.append(
            Interval(f"{row['feature']}  {row['eta']:+.2f}", row["rmm"], row["rmm"] - half, row["rmm"] + half)
        )
    figure = draw_intervals(
        intervals,
        title="What each feature earns",
        x_label="RMM, predicted to first order; beside the names eta",
        zero=True,
    )
    save_figure(model / "calibration.png", figure)
    return model / "calibration.png"
