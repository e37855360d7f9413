"""Machine code gives the numbers of the text that it is made of, and of the metric."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from rlftsim.envs.road import MAX_PAIRS, EdgeArrays, measure_road_edge, road_edges
from rlftsim.realism.map_based import compute_point_distance_to_road_edge, join_road_edges
from rlftsim.scenario.open import open_dataset

EPISODE = """
import hashlib
import numpy as np
from rlftsim.envs import EgoVectorEnv
from rlftsim.scenario.open import open_dataset
data = open_dataset("synthetic", "validation")
env = EgoVectorEnv(2, scenarios=[data[0], data[1]], traffic="replay", observation="flat")
digest = hashlib.sha256(env.reset(seed=0)[0].tobytes())
for _ in range(3):
    observation, reward, *_ = env.step(np.full((2, 2), 0.3, np.float32))
    digest.update(observation.tobytes() + reward.tobytes())
print(digest.hexdigest())
"""


def test_without_numba_environments_have_equal_bits():
    pytest.importorskip("numba")
    variables = [{}, {"NUMBA_DISABLE_JIT": "1"}]
    runs = [
        subprocess.run(
            [sys.executable, "-c", EPISODE], env=os.environ | new, capture_output=True, text=True, check=True
        )
        for new in variables
    ]
    assert runs[0].stdout == runs[1].stdout != ""


def test_without_numba_a_line_says_so_once():
    code = "import sys; sys.modules['numba'] = None; import rlftsim.envs.ego_env, rlftsim.envs.road"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr.count("UserWarning") == run.stderr.count("pip install 'rlftsim[env]'.") == 1
    assert "environments are many times slower without numba" in run.stderr


def test_the_distance_to_the_road_edge_has_the_bits_of_the_metric():
    data, random = open_dataset("synthetic", "validation"), np.random.default_rng(0)
    maps = [data[i].map_features for i in range(4)]
    edges = join_road_edges([road_edges(data[i]) for i in range(4)])
    scenario = np.repeat(random.integers(0, 4, 500), 4)
    points = np.stack([maps[i].points[random.integers(len(maps[i].points))] for i in scenario])
    points += random.normal(size=points.shape) * [8.0, 8.0, 0.3] * random.integers(0, 2, (len(points), 1))
    points = points.astype(np.float32)
    distances = np.empty(len(points), np.float32)
    measure_road_edge(points, scenario, EdgeArrays.from_edges(edges), distances)
    groups, of_group = torch.from_numpy(points).view(-1, 4, 3), torch.from_numpy(scenario[::4].copy())
    expected = compute_point_distance_to_road_edge(groups, edges, max_pairs=MAX_PAIRS, scenario=of_group)
    np.testing.assert_array_equal(distances, expected.flatten().numpy())
