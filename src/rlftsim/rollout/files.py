"""Rollouts as files: one npz a scenario, in the layout that `rlftsim score` and other tools read.

Keys: scenario_id, object_ids [A], x y z heading [N, A, 80] float32, world frame.
"""

from pathlib import Path

import numpy as np

from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP


def write_rollouts(folder: Path, batch: ScenarioBatch, rollouts: Rollouts) -> list[Path]:
    """Write each scenario's rollouts to `folder/<scenario id>.npz`, whole or not at all. Returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    world = batch.to_world(rollouts.position).cpu().numpy()
    heading, z = rollouts.heading.float().cpu().numpy(), batch.z[:, :, CURRENT_STEP].cpu().numpy()
    files = []
    for b, scenario in enumerate(batch.scenarios):
        chosen = scenario.simulated_indices
        own = heading[b, :, : len(chosen)]
        path = folder / f"{scenario.scenario_id}.npz"
        partial = folder / f".{path.name}.partial"
        with partial.open("wb") as file:
            np.savez_compressed(
                file, scenario_id=np.array(scenario.scenario_id), object_ids=scenario.tracks.object_id[chosen].astype(np.int32),
                x=world[b, :, : len(chosen), :, 0], y=world[b, :, : len(chosen), :, 1],
                z=np.broadcast_to(z[b, : len(chosen), None], own.shape), heading=own,
            )  # fmt: skip
        partial.replace(path)
        files.append(path)
    return files
