"""Archives drawn by hand, without a simulation, and a policy that costs nothing; for tests of submissions."""

import io
import tarfile
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import scenes
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.realism import SimulatedStates
from rlftsim.rollout.baselines import ConstantVelocity, PointMass
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.submission.entry import Entry, describe_entry
from rlftsim.submission.messages import encode_rollouts
from rlftsim.submission.plan import Job, make_plan

ENTRY = Entry(
    "jane.doe@university.edu", "A method", ("Jane Doe", "John Roe"), "A university", "A model.", "https://doe.edu/a"
)
METADATA = describe_entry(ENTRY, "7M")
TOML = """
account = "jane.doe@university.edu"
method = "A method"
authors = ["Jane Doe"]
affiliation = "A university"
description = "A model."
link = "https://doe.edu/a"
"""
"""A file that describes an entry."""


@dataclass(frozen=True, eq=False)
class Varied(PointMass):
    """Velocities that differ by rollout and agent."""

    def sample(self, sampling, noise: Float[Tensor, "... noise"]):
        return self.decision * (0.9 + 0.2 * noise)


class Wanderer(ConstantVelocity):
    """Constant velocity with a random pace; `fails_at` ends the process there, as a crash does."""

    architecture = "wanderer"
    noise_size = 1
    steps_per_decision = 1

    def decide(self, context, state):
        return Varied(state.velocity)


def scenario(number: int):
    """One of several scenarios of 4 to 6 agents."""
    scenario_id = f"{0xA0 + number:x}"
    if number == 2:
        return scenes.without_map(scenario_id)
    if number == 5:
        return scenes.without_future(scenario_id)
    return scenes.build_scenario(scenario_id, scenes.TRAFFIC[: 4 + number % 3])


def write_data(folder, num_scenarios=12):
    """A data set whose split "testing" has a scenario without a map and one of 11 steps, and one of another split."""
    drawn = [*(scenario(n) for n in range(num_scenarios)), scenes.straight_road("another")]
    write_dataset(drawn, folder, split=lambda s: "training" if s.scenario_id == "another" else "testing")
    return ScenarioDataset(folder, "testing")


def draw_states(drawn, seed=0):
    """32 rollouts of constant velocity with a random pace."""
    rng = np.random.default_rng(seed)
    tracks, rows = drawn.tracks, drawn.simulated_indices
    time = 0.1 * np.arange(1, 81)
    pace = rng.uniform(0.9, 1.1, (32, len(rows), 1))
    x, y = (tracks.position[rows, 10, a, None] + pace * tracks.velocity[rows, 10, a, None] * time for a in range(2))
    z = np.broadcast_to(tracks.position[rows, 10, 2, None], x.shape)
    heading = np.broadcast_to(tracks.heading[rows, 10, None], x.shape)
    arrays = (torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (x, y, z, heading))
    return SimulatedStates(tracks.object_id[rows], *arrays)


def draw_shards(data, num_shards=3):
    """Messages by the names of their shards."""
    shards = {}
    for number in range(num_shards):
        message = SimAgentsChallengeSubmission.FromString(METADATA)
        for drawn in data[number::num_shards]:
            message.scenario_rollouts.add().MergeFromString(encode_rollouts(drawn.scenario_id, draw_states(drawn)))
        shards[f"submission.binproto-{number:05d}-of-{num_shards:05d}"] = message
    return shards


def pack(path, shards, mode="w:gz"):
    """Write messages or bytes as an archive."""
    with tarfile.open(path, mode) as tar:
        for name, message in shards.items():
            data = message if isinstance(message, bytes) else message.SerializeToString()
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    return path


def make_job(data, folder, policy=None, *, num_shards=4, round_m=None, **config):
    """Input of a build."""
    policy = policy or Wanderer()
    settings = EvaluateConfig(split="testing", rollouts_per_pass=32, **config)
    plan = make_plan(
        data, fingerprint_policy(policy), METADATA, replace(settings, jobs=1), num_shards=num_shards, round_m=round_m
    )
    return Job(policy, data, plan, METADATA, settings, round_m, folder)
