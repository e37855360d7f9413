"""Rollouts as files: one npz a scenario, in the layout that `rlftsim score` and other tools read.

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
        folder: created where it is missing.
        batch: the scenarios.
        rollouts: of these, map frame. The height of an agent stays that of the current step.

    Returns:
        The files, in the order of the batch.
    """
    world = batch.to_world(rollouts.position).cpu().numpy()
    # rollouts are two-dimensional: heights stay those of the current step
    heading, z = rollouts.heading.float().cpu().numpy(), batch.z[:, :, CURRENT_STEP].cpu().numpy()
    files = []
    for b, scenario in enumerate(batch.scenarios):
        chosen = scenario.simulated_indices
        own = heading[b, :, : len(chosen)]  # [N, A, 80] without padding
        path = folder / f"{scenario.scenario_id}.npz"
        save = partial(
            _write_npz,
            scenario_id=np.array(scenario.scenario_id),
            object_ids=scenario.tracks.object_id[chosen],
            x=world[b, :, : len(chosen), :, 0],
            y=world[b, :, : len(chosen), :, 1],
            z=np.broadcast_to(z[b, : len(chosen), None], own.shape),
            heading=own,
        )
        write_atomically(path, save)
        files.append(path)
    return files


def _write_npz(path: Path, **arrays: np.ndarray) -> None:
    with path.open("wb") as file:  # by name, numpy would append .npz
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType] (numpy's stub)
