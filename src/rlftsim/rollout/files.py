"""Rollouts as files: an npz per scenario, in the layout that `rlftsim score` and other tools read.

Keys: scenario_id, object_ids [A] int64, x y z heading [N, A, 80] float32, world frame.
"""

from functools import partial
from pathlib import Path

import numpy as np

from rlftsim.jobs.files import write_atomically
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP


def write_rollouts(folder: Path, batch: ScenarioBatch, rollouts: Rollouts) -> list[Path]:
    """Write each scenario's rollouts to `folder/<scenario id>.npz`, each file whole or not at all.

    Args:
        folder: Folder of the files, created where it is missing.
        batch: Scenarios that the rollouts continue, in the same order, with ids, heights and the world frame.
        rollouts: Simulated futures in the map frame. The height of an agent stays that of the current step.

    Returns:
        The files, in the order of the batch.
    """
    world = batch.to_world(rollouts.position).cpu().numpy()
    headings, heights = rollouts.heading.float().cpu().numpy(), batch.z[:, :, CURRENT_STEP].cpu().numpy()
    files = [folder / f"{scenario.scenario_id}.npz" for scenario in batch.scenarios]
    for b, (file, scenario) in enumerate(zip(files, batch.scenarios)):
        indices = scenario.simulated_indices
        heading = headings[b, :, : len(indices)]  # [N, A, 80] without padding
        x, y = (world[b, :, : len(indices), :, axis] for axis in range(2))
        z = np.broadcast_to(heights[b, : len(indices), None], heading.shape)
        ids = {"scenario_id": np.array(scenario.scenario_id), "object_ids": scenario.tracks.object_id[indices]}
        write_atomically(file, partial(_write_npz, **ids, x=x, y=y, z=z, heading=heading))
    return files


def _write_npz(path: Path, **arrays: np.ndarray) -> None:
    with path.open("wb") as file:  # by name, numpy would append .npz
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType] (numpy's stub)
