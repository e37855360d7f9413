"""An experiments folder of release 0.1 opens: all its stages are found finished, and its numbers are the same."""

import json
import os
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.evaluation.results import ADDED_COLUMNS, Evaluation
from rlftsim.experiments.model_specs import BASE, FineTuned, GoalTraining, Guided
from rlftsim.experiments.paper import controllability, maneuver_goals, variance_scaling
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.goals.goals_file import read_goals
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.tokens.clustering import TokensConfig
from rlftsim.training.alarms import AlarmConfig
from rlftsim.training.catk import CatkConfig
from rlftsim.training.finetune_config import FinetuneConfig
from rlftsim.training.goal_relabeling import GcslConfig
from rlftsim.training.parallel import DeviceConfig
from rlftsim.training.pretrain import PretrainConfig
from rlftsim.training.reference import KlConfig
from rlftsim.training.validation import ValidationConfig

STORED = Path(__file__).parents[1] / "data" / "stored_0_1"
CPU = DeviceConfig(accelerator="cpu", threads=1)
RECIPE = SmartRecipe(
    tokens=TokensConfig(num_tokens=16, num_map_prototypes=8),
    model=SmartConfig(
        dim=4, num_heads=2, head_dim=2, num_map_layers=1, num_decoder_layers=1, num_frequencies=1, history_tokens=2,
        max_map_neighbors=3, max_agent_map_neighbors=3, max_agent_neighbors=3,
    ),
    pretrain=PretrainConfig(
        epochs=2.5, batch_size=2, micro_batch_size=1, learning_rate=1e-2, warmup_updates=1, checkpoint_every=2, seed=3,
        validation=ValidationConfig(every=3, num_scenarios=2, num_rollouts=2), device=CPU,
    ),
    finetune=FinetuneConfig(
        epochs=1.0, batch_size=2, micro_batch_size=1, num_rollouts=2, rollouts_per_pass=1, learning_rate=1e-2,
        warmup_updates=2, reward="mloo + 0.1*collision_offroad", checkpoint_every=2,
        kl=KlConfig(reference_sync_every=2, reference_ema=0.25), alarms=AlarmConfig(first_updates=2, window=2),
        device=CPU,
    ),
    catk=CatkConfig(
        epochs=1.25, batch_size=1, learning_rate=1e-2, num_candidates=4, max_distance_lengths=2.0, goal_probability=0.5,
        goal_learning_rate_scale=2.0, checkpoint_every=2, device=CPU,
    ),
    gcsl=GcslConfig(epochs=1.25, batch_size=1, num_rollouts=2, checkpoint_every=2, device=CPU),
)  # fmt: skip
"""Settings of the stored folder, as `stored_0_1/make.py` has them."""
GCSL = FineTuned("gcsl", goals=GoalTraining("concat"))
GCFT = FineTuned("gcft", "agent", base=GCSL, goals=GoalTraining("concat", "soft", weight=0.2))
SPECS = {"base": BASE, "MLOO": FineTuned("mloo"), "told": GCSL, "asked": GCFT, "guided": Guided(GCFT, 2.0)}
"""By the names of rows in `expected.json`, which are those of 0.1."""


@pytest.fixture(scope="module")
def expected():
    """Results of release 0.1."""
    return json.loads((STORED / "expected.json").read_text())["experiments"]


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """The stored folder, opened by today's code with its working directory as it was."""
    folder, before, threads = tmp_path_factory.mktemp("stored"), Path.cwd(), torch.get_num_threads()
    with tarfile.open(STORED / "stored.tar.xz") as tar:
        tar.extractall(folder)
    os.chdir(folder)
    evaluation = EvaluateConfig(num_rollouts=4, limit=2)
    yield ExperimentSuite(RECIPE, Path("data"), Path("experiments"), evaluation, base_model="models/base")
    os.chdir(before)
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def _nothing_is_repeated(suite):
    """Results stay as they were written; of finished runs, which write their model again, the contents stay."""

    def stamps():
        results = [*suite.out.rglob("*.parquet"), *suite.out.glob("variances/*"), *suite.out.glob("*.goals.json")]
        results += suite.out.glob("attainment/**/*.json")
        runs = [*suite.out.glob("runs/*/*/metrics.jsonl"), *suite.out.glob("runs/*/*/model/model.safetensors")]
        return {path: path.stat().st_mtime_ns for path in results}, {path: path.read_bytes() for path in runs}

    before = stamps()
    assert [len(files) for files in before] == [8 + 2 + 1 + 6, 2 * 3]
    yield
    assert stamps() == before


def rmm_of(rows):
    """Meta-metric of every scenario, by row."""
    return {name: row.mean.values("meta_metric").tolist() for name, row in rows.items()}


def test_models_and_evaluations_are_found(suite, expected, capsys):
    rows = suite.evaluate({name: (spec,) for name, spec in SPECS.items()})
    conditioned = suite.evaluate({name: (SPECS[name],) for name in ("told", "asked", "guided")}, goals="logged")
    assert rmm_of(rows) == expected["measured"]
    assert rmm_of(conditioned) == expected["measured_with_goals"]
    stages = [line for line in capsys.readouterr().err.splitlines() if "evaluate " in line or "fine-tune " in line]
    assert len(stages) == 3 + 5 + 2 + 3
    assert all(line.endswith("(finished before)") for line in stages)


def test_all_stored_scores_are_the_same(suite, expected):
    found = {path.stem: Evaluation.read(path).table.to_pylist() for path in suite.out.glob("evaluations/*.parquet")}
    assert found.keys() == expected["evaluations"].keys()
    for name, rows in expected["evaluations"].items():
        own = [{column: value for column, value in row.items() if column not in ADDED_COLUMNS} for row in found[name]]
        assert json.dumps(own) == json.dumps(rows)  # NaN equals NaN


def test_attainment_of_goals_is_found(suite, expected):
    file = read_goals(maneuver_goals.goals_path(suite))
    rows = {name: SPECS[name] for name in ("base", "asked", "guided")}
    goals = [*file.goals, *file.alternatives]
    found = controllability.measure_attainment(suite, rows, goals, name=maneuver_goals.NAME)
    assert {name: [[one.reached, one.passed] for one in ones] for name, ones in found.items()} == expected["attained"]


def test_variances_are_found(suite, expected):
    found = variance_scaling.EXPERIMENT.run(suite)
    assert {name: values.tolist() for name, values in found.by_reward.items()} == expected["variances"]


def test_another_recipe_is_refused(suite):
    other = replace(RECIPE, finetune=replace(RECIPE.finetune, epochs=2.0))
    with pytest.raises(Exception, match=r"belongs to a run with other settings or inputs \(recipe\.finetune\.epochs\)"):
        replace(suite, recipe=other)
