"""Rollouts of scenarios in files, as other simulators write them."""

import numpy as np

from rlftsim.evaluation import submission_pb2

AXES = ("x", "y", "z", "heading")


def draw_arrays(scenario, num_rollouts=4, seed=0):
    """The log with a smooth offset per agent and rollout: the arrays of an npz."""
    random = np.random.default_rng(seed)
    chosen = scenario.simulated_indices
    ramp = np.linspace(0, 1, 80) ** 2
    push = random.normal(0, 1.5, (4, num_rollouts, len(chosen), 1)) * ramp
    tracks = scenario.tracks
    values = [*np.moveaxis(tracks.position[chosen, 11:], -1, 0), tracks.heading[chosen, 11:]]
    arrays = {
        axis: (v[None] + p * scale).astype(np.float32)
        for axis, v, p, scale in zip(AXES, values, push, (1, 1, 0.01, 0.1))
    }
    return {
        "scenario_id": np.array(scenario.scenario_id),
        "object_ids": tracks.object_id[chosen].astype(np.int32),
        **arrays,
    }


def write_npz(path, arrays):
    np.savez_compressed(path, **arrays)
    return path


def to_scenario_rollouts(arrays):
    """The official message of one scenario; agents in another order in every rollout."""
    message = submission_pb2.ScenarioRollouts(scenario_id=str(arrays["scenario_id"]))
    for rollout in range(len(arrays["x"])):
        scene = message.joint_scenes.add()
        for agent in np.random.default_rng(rollout).permutation(len(arrays["object_ids"])):
            scene.simulated_trajectories.add(
                object_id=int(arrays["object_ids"][agent]),
                center_x=arrays["x"][rollout, agent].tolist(),
                center_y=arrays["y"][rollout, agent].tolist(),
                center_z=arrays["z"][rollout, agent].tolist(),
                heading=arrays["heading"][rollout, agent].tolist(),
            )
    return message


def write_submission(path, *all_arrays):
    message = submission_pb2.SimAgentsChallengeSubmission(
        scenario_rollouts=[to_scenario_rollouts(arrays) for arrays in all_arrays]
    )
    # fields of the official message that ours leaves out: submission_type = 1, account_name = "me"
    path.write_bytes(message.SerializeToString() + b"\x10\x01\x1a\x02me")
    return path
