import json
import multiprocessing
import re
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import rlftsim as rs
import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation import evaluate as module
from rlftsim.evaluation import rollout_states
from rlftsim.evaluation.evaluate import EvaluateConfig, Evaluation, evaluate
from rlftsim.evaluation.results import NUMBERS_VERSION, SCORE_COLUMNS
from rlftsim.evaluation.resumable import ScenarioRows, open_evaluation
from rlftsim.jobs.items import do_group, run_items
from rlftsim.jobs.runner import Inline, Joining, Share, Unfinished
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.realism import score
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.types import HISTORY_STEPS
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

CONFIG = EvaluateConfig(num_rollouts=4, rollouts_per_pass=2)


@dataclass(frozen=True)
class Wobble(ConstantVelocity):
    """Constant velocity and a random push: enough of a random policy for an evaluation."""

    strength_mps: float = 1.0
    noise_size = 2

    def decide(self, context, state):
        return _Wobbling(super().decide(context, state).decision, self.strength_mps)


@dataclass(frozen=True)
class _Wobbling:
    decision: torch.Tensor
    strength_mps: float

    def sample(self, sampling, noise):
        return self.decision + self.strength_mps * (noise - 0.5)

    def log_prob(self, decision, sampling):
        return torch.zeros_like(decision[..., 0])

    def kl(self, other):
        return torch.zeros_like(self.decision[..., 0])

    def entropy(self):
        return torch.zeros_like(self.decision[..., 0])


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """Six scenarios that can be scored and one that cannot."""
    scenarios = [
        scenes.straight_road(),
        scenes.junction_with_light(),
        scenes.without_road_edges(),
        scenes.lone_agent(),
        scenes.with_gaps(),
        scenes.straight_road("again"),
        scenes.crowd(num_agents=9),
    ]
    folder = tmp_path_factory.mktemp("evaluate") / "data"
    write_dataset(scenarios, folder, split="validation")
    return folder


def same(a: Evaluation, b: Evaluation) -> bool:
    # By text, in which NaN is NaN: no evaluated agent of a scenario may stay on the road in the log.
    return repr(a.table.to_pylist()) == repr(b.table.to_pylist()) and a.skipped == b.skipped


def test_oracle_has_the_scores_of_the_log_itself(data, tmp_path):
    result = evaluate("oracle", data, tmp_path, CONFIG, name="oracle")
    scenario = ScenarioDataset(data).by_id("straight")
    expected = score(scenario, logged_states(scenario, num_rollouts=4))
    row = result.scenario_ids.index("straight")
    assert result.values("meta_metric")[row] == pytest.approx(float(expected.meta_metric))
    assert result.values("linear_speed_likelihood")[row] == pytest.approx(float(expected.likelihood("linear_speed")))
    # logged agents end where the log does, but for agents whose log ends early
    assert result.values("min_average_displacement_error")[row] == 0
    assert result.table["num_agents"].to_pylist()[row] == 6
    assert result.table["num_evaluated"].to_pylist()[row] == 4


def test_what_cannot_be_scored_is_listed_with_the_reason(data, tmp_path):
    result = evaluate("oracle", data, tmp_path, CONFIG, name="oracle")
    assert [s.scenario_id for s in result.skipped] == ["no-edges"]
    assert "no road edge" in result.skipped[0].reason
    assert len(result) == 6


def test_a_scenario_that_cannot_be_evaluated_is_named_with_the_reason():
    result = rs.evaluate("oracle", scenes.without_road_edges(), num_rollouts=1)
    assert "0 scenarios (1 skipped: Scenario no-edges has no road edge" in repr(result)
    assert "missing_map" not in repr(result)
    with pytest.raises(DataError, match=r"^1 of 1 scenarios withhold their future, the first is test-split with 11"):
        rs.evaluate("oracle", scenes.without_future(), num_rollouts=1)


@pytest.mark.parametrize("sampling", [rs.Sampling(temperature=0.5), rs.Sampling(top_k=5)])
@pytest.mark.parametrize("policy", ["oracle", "constant_velocity"])
def test_sampling_is_refused_where_nothing_is_sampled(policy, sampling):
    with pytest.raises(ConfigError, match=r"(temperature 0.5|top_k 5) has no effect, as \w+ samples no decisions"):
        rs.evaluate(policy, scenes.straight_road(), sampling=sampling)
    with pytest.raises(ConfigError, match="has no effect, as ConstantVelocity samples no decisions"):
        rs.simulate(ConstantVelocity(), scenes.straight_road(), num_rollouts=2, sampling=sampling)


def test_a_future_of_padding_is_no_future(tmp_path):
    padded = scenes.without_agents(slice(HISTORY_STEPS, None))
    write_dataset([scenes.straight_road(), padded], tmp_path / "data", split="validation")
    result = evaluate(ConstantVelocity(), tmp_path / "data", tmp_path, CONFIG, name="cv")
    assert result.scenario_ids == ["straight"]
    assert [s.scenario_id for s in result.skipped] == ["padded"]
    assert "no valid logged state of an evaluated agent after the current step" in result.skipped[0].reason


def test_a_deterministic_policy_is_simulated_once_and_scored_as_if_every_time(data, tmp_path, monkeypatch):
    simulated = []
    original = rollout_states.simulate
    monkeypatch.setattr(
        rollout_states, "simulate", lambda *a, **k: simulated.append(len(k["num_rollouts"])) or original(*a, **k)
    )
    config = replace(CONFIG, limit=1)
    once = evaluate(ConstantVelocity(), data, tmp_path, config, name="cv")
    assert simulated == [1]
    random = evaluate(Wobble(strength_mps=0.0), data, tmp_path, config, name="still")
    assert simulated == [1, 2, 2]
    for column in SCORE_COLUMNS:
        np.testing.assert_allclose(once.values(column), random.values(column), atol=1e-6)


def test_neither_passes_nor_processes_change_a_number(data, tmp_path):
    results = [
        evaluate(Wobble(), data, tmp_path, config, name=f"w{k}")
        for k, config in enumerate([CONFIG, replace(CONFIG, rollouts_per_pass=3), replace(CONFIG, jobs=2)])
    ]
    assert same(results[0], results[1])
    assert same(results[0], results[2])
    assert not multiprocessing.active_children()


def test_a_model_with_weights_is_evaluated_in_processes_and_left_as_it_was(data, tmp_path):
    scenarios = [scenes.straight_road(), scenes.crowd(num_agents=20)]
    vocabulary, _ = build_vocabulary(scenarios, TokensConfig(num_tokens=16, num_map_prototypes=8))
    policy = SmartPolicy(
        SmartConfig(dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=1, num_frequencies=4),
        vocabulary,
    ).train()
    config = replace(CONFIG, num_rollouts=2)
    alone = evaluate(policy, data, tmp_path, config, name="alone")
    assert same(alone, evaluate(policy, data, tmp_path, replace(config, jobs=2), name="together"))
    assert policy.training
    assert all(weight.requires_grad for weight in policy.parameters())


def test_an_evaluation_comes_back_from_its_file(data, tmp_path):
    result = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    back = Evaluation.read(tmp_path / "w.parquet")
    assert same(result, back)
    assert back.provenance == result.provenance
    assert back.config == CONFIG
    assert back.name == "w"


def test_an_interrupted_run_goes_on_with_what_is_missing(data, tmp_path, monkeypatch):
    whole = evaluate(Wobble(), data, tmp_path, CONFIG, name="whole")
    original, seen = module.scenario_log, []

    def interrupt_at_the_sixth(scenario, device, **rules):
        if len(seen) == 5:
            raise KeyboardInterrupt
        seen.append(scenario.scenario_id)
        return original(scenario, device, **rules)

    monkeypatch.setattr(module, "scenario_log", interrupt_at_the_sixth)
    with pytest.raises(KeyboardInterrupt):
        evaluate(Wobble(), data, tmp_path, CONFIG, name="cut")
    assert not (tmp_path / "cut.parquet").exists()
    assert len(list((tmp_path / "cut.parts").glob("*.parquet"))) == 1
    rest = []

    def note(scenario, device, **rules):
        rest.append(scenario.scenario_id)
        return original(scenario, device, **rules)

    monkeypatch.setattr(module, "scenario_log", note)
    assert same(evaluate(Wobble(), data, tmp_path, CONFIG, name="cut"), whole)
    assert rest == ["gaps", "again", "crowd"]
    assert not (tmp_path / "cut.parts").exists()
    rest.clear()
    assert same(evaluate(Wobble(), data, tmp_path, CONFIG, name="cut"), whole)
    assert rest == []


def test_a_quick_look_keeps_what_a_longer_evaluation_has_done(data, tmp_path, monkeypatch):
    with pytest.raises(Unfinished):
        evaluate(Wobble(), data, tmp_path, CONFIG, name="run", runner=Share(1, 2, Inline()))
    parts = sorted((tmp_path / "run.parts").glob("*.parquet"))
    assert parts
    for limit in (1, 4, 4):  # also where the share has done no more than the quick look, and repeated
        evaluate(Wobble(), data, tmp_path, replace(CONFIG, limit=limit), name="run")
        assert set(parts) <= set((tmp_path / "run.parts").glob("*.parquet"))
    evaluate(Wobble(), data, tmp_path, CONFIG, name="run", runner=Share(2, 2, Inline()))
    assert not (tmp_path / "run.parts").exists()


def test_unfinished_parts_of_other_settings_outlive_a_repeated_command(data, tmp_path):
    with pytest.raises(Unfinished):
        evaluate(Wobble(), data, tmp_path, replace(CONFIG, seed=1), name="run", runner=Share(2, 2, Inline()))
    (part,) = (tmp_path / "run.parts").glob("*.parquet")
    for _ in range(2):
        evaluate(Wobble(), data, tmp_path, replace(CONFIG, limit=4), name="run")
        assert part.exists()


@pytest.mark.parametrize(
    ("policy", "config", "what"),
    [
        (Wobble(strength_mps=2.0), CONFIG, r"policy_fingerprint \(\w{8}, not \w{8}\)"),
        (Wobble(), replace(CONFIG, seed=1), r"seed \(0, not 1\)"),
    ],
)
def test_a_result_of_another_policy_or_other_settings_is_not_replaced(data, tmp_path, policy, config, what):
    old = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    with pytest.raises(ConfigError, match=rf"w\.parquet is the result of another {what}: choose another --name"):
        evaluate(policy, data, tmp_path, config, name="w")
    assert same(Evaluation.read(tmp_path / "w.parquet"), old)


def test_only_the_files_of_an_evaluation_are_removed_with_its_parts(data, tmp_path):
    (tmp_path / "w.parts").mkdir()
    (tmp_path / "w.parts" / "notes.txt").write_text("of a user")
    evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    assert [path.name for path in (tmp_path / "w.parts").iterdir()] == ["notes.txt"]


def test_parts_of_another_policy_are_replaced_with_a_message(data, tmp_path, capsys):
    expected = evaluate(Wobble(strength_mps=2.0), data, tmp_path, CONFIG, name="expected")
    old = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    parts = ScenarioRows("parts", old.provenance, tmp_path, old.scenario_ids)
    parts.write(range(0, 4), [dict(row) for row in old.table.slice(0, 4).to_pylist()])
    assert same(evaluate(Wobble(strength_mps=2.0), data, tmp_path, CONFIG, name="parts"), expected)
    error = capsys.readouterr().err
    assert re.search(r"another policy_fingerprint \(\w{8}, not \w{8}\): it will be replaced", error)


@pytest.mark.parametrize("runner", [Share(2, 2, Inline()), Joining()])
def test_shares_of_other_settings_are_refused_with_both_values_and_stay(data, tmp_path, monkeypatch, runner):
    with pytest.raises(Unfinished):
        evaluate(Wobble(), data, tmp_path, CONFIG, name="w", runner=Share(1, 2, Inline()))
    parts = {path: path.read_bytes() for path in (tmp_path / "w.parts").glob("*.parquet")}
    monkeypatch.setattr(module, "simulate_states", None)  # nothing is simulated before
    with pytest.raises(
        ConfigError, match=r"another num_rollouts \(4, not 2\): shares need the same .* remove the folder"
    ):
        evaluate(Wobble(), data, tmp_path, replace(CONFIG, num_rollouts=2), name="w", runner=runner)
    assert {path: path.read_bytes() for path in (tmp_path / "w.parts").glob("*.parquet")} == parts


def test_a_damaged_part_is_made_again(data, tmp_path, capsys):
    expected = evaluate(Wobble(), data, tmp_path, CONFIG, name="expected")
    (tmp_path / "w.parts").mkdir()
    (tmp_path / "w.parts" / "000000-000004.parquet").write_bytes(b"PAR1 nonsense")
    assert same(evaluate(Wobble(), data, tmp_path, CONFIG, name="w"), expected)
    assert "damaged" in capsys.readouterr().err


def test_a_result_with_doubled_rows_is_made_again(data, tmp_path):
    expected = evaluate("oracle", data, tmp_path, CONFIG, name="o")
    replace(expected, table=pa.concat_tables([expected.table, expected.table])).write(tmp_path / "o.parquet")
    assert same(evaluate("oracle", data, tmp_path, CONFIG, name="o"), expected)
    assert same(Evaluation.read(tmp_path / "o.parquet"), expected)


def test_a_higher_limit_adds_scenarios(data, tmp_path):
    few = evaluate(Wobble(), data, tmp_path, replace(CONFIG, limit=2), name="w")
    assert few.scenario_ids == ["straight", "junction"]
    assert len(evaluate(Wobble(), data, tmp_path, CONFIG, name="w")) == 6


def test_a_limit_never_replaces_a_larger_result(data, tmp_path):
    whole = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    few = replace(CONFIG, limit=2)
    for policy in (Wobble(), Wobble(strength_mps=2.0)):  # of the same work, and of another
        with pytest.raises(ConfigError, match=r"w\.parquet holds 7 scenarios, and limit=2 .*--name"):
            evaluate(policy, data, tmp_path, few, name="w")
    assert same(Evaluation.read(tmp_path / "w.parquet"), whole)
    assert len(evaluate(Wobble(), data, tmp_path, replace(CONFIG, limit=7), name="w")) == 6
    assert len(evaluate(Wobble(), data, tmp_path, few, name="few")) == 2


def test_a_release_that_changes_no_number_leaves_results_valid(data, tmp_path, monkeypatch):
    old = evaluate(Wobble(), data, tmp_path, replace(CONFIG, limit=1), name="w")
    assert old.provenance.what_counts()["rlftsim_version"] == NUMBERS_VERSION
    later = replace(old.provenance, package_version="9.9.9")
    assert later.differences(old.provenance) == []
    assert replace(later, rlftsim_version="9.9.9").differences(old.provenance) == ["rlftsim_version"]


def test_an_evaluation_needs_no_folder_and_takes_an_opened_data_set(data, tmp_path):
    opened = ScenarioDataset(data, "validation")
    result = evaluate(Wobble(), opened, config=replace(CONFIG, split=None, limit=2))
    assert result.config.split == "validation"
    assert result.name.startswith("Wobble-")
    stored = evaluate(Wobble(), str(data), str(tmp_path), replace(CONFIG, limit=2))
    assert same(stored, result)
    assert [path.name for path in tmp_path.iterdir()] == [f"{result.name}.parquet"]
    assert stored.name == f"Wobble-{fingerprint_policy(Wobble())[:8]}"


def test_an_evaluation_is_shown_in_a_few_words(data):
    result = evaluate(Wobble(), data, None, replace(CONFIG, limit=3), name="<w>")
    mean = result.mean_and_error("meta_metric")
    assert repr(result).startswith("<w>, 2 scenarios (1 skipped) x 4 rollouts, metric 2025: RMM ")
    assert f"RMM {mean.mean:.4f} ± {mean.standard_error:.4f} | kinematic" in repr(result)
    assert len(repr(result)) < 400
    html = result._repr_html_()
    assert "&lt;w&gt;" in html
    assert html.count("<td>") == 7
    np.testing.assert_array_equal(result["meta_metric"], result.values("meta_metric"))


def test_nan_in_a_valid_state_is_refused(data, tmp_path, monkeypatch):
    broken = scenes.straight_road()
    broken.tracks.position[2, 30, 0] = np.nan
    monkeypatch.setattr(ScenarioDataset, "__getitem__", lambda self, position: broken)
    with pytest.raises(DataError, match=r"scenario straight: track 102 has a NaN .* at step 30.*convert"):
        evaluate("oracle", data, tmp_path, CONFIG, name="oracle")


@dataclass(frozen=True)
class Loses(ConstantVelocity):
    """Constant velocity that loses one agent's poses: they are NaN from the first decision on."""

    agent: int = 0

    def advance(self, context, state, decision, forced=None):
        after = super().advance(context, state, decision, forced)
        after.poses[:, :, self.agent] = np.nan
        return after


@pytest.mark.parametrize("agent", [0, 2])
def test_a_policy_whose_poses_are_not_finite_is_refused(data, agent):
    ids = scenes.straight_road().tracks.object_id
    message = f"Loses moves agent {ids[agent]} of scenario straight in rollout 0 at step 0 to x nan m"
    with pytest.raises(DataError, match=message):
        evaluate(Loses(agent=agent), data, None, replace(CONFIG, limit=1), name="loses")


def test_work_in_parts_is_joined_in_order_and_skipped_scenarios_are_kept(data, tmp_path):
    provenance = evaluate("oracle", data, None, replace(CONFIG, limit=1), name="o").provenance
    row = dict.fromkeys(("num_agents", "num_evaluated"), 1) | dict.fromkeys(SCORE_COLUMNS, 0.5) | {"cluster": ""}
    done = []

    def work(position):
        done.append(position)
        scenario_id = f"s{position}"
        return {"scenario_id": scenario_id, **row} if position % 3 else module.Skipped(scenario_id, "a third is")

    ids = [f"s{position}" for position in range(10)]
    with open_evaluation("made", provenance, tmp_path, ids, runner=Inline(), jobs=1) as (rows, lease):
        task = partial(do_group, work, rows)
        rows.join(run_items("make", rows.groups, task, format=rows, lease=lease, show_progress=False))
    result = ScenarioRows("made", provenance, tmp_path, ids).read_finished()
    assert (done, result.scenario_ids) == (list(range(10)), ["s1", "s2", "s4", "s5", "s7", "s8"])
    assert [skipped.scenario_id for skipped in result.skipped] == ["s0", "s3", "s6", "s9"]


def test_a_withheld_future_is_refused_before_anything_is_done(tmp_path):
    write_dataset([scenes.straight_road(), scenes.without_future()], tmp_path / "data", split="testing")
    config = replace(CONFIG, split="testing")
    with pytest.raises(
        DataError, match="1 of 2 scenarios withhold their future, the first is test-split with 11 steps"
    ):
        evaluate(ConstantVelocity(), tmp_path / "data", tmp_path / "out", config, name="cv")
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_worker_is_the_error_of_the_evaluation(data, tmp_path):
    config = replace(CONFIG, jobs=2, top_k=5)
    with pytest.raises(ConfigError, match="needs a policy with categories"):
        evaluate(ConstantVelocity(), data, tmp_path, config, name="cv")


def test_the_light_term_set_to_one_adds_what_it_lacks(data, tmp_path):
    result = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    light = result.values("traffic_light_violation_likelihood")
    expected = result.values("meta_metric") + 0.05 * (1 - light)
    np.testing.assert_allclose(result.values("meta_metric_light_one"), expected, atol=1e-6)


def test_mean_and_standard_error_over_scenarios(data, tmp_path):
    result = evaluate(Wobble(), data, tmp_path, CONFIG, name="w")
    values = result.values("kinematic")
    found = result.mean_and_error("kinematic")
    assert found.count == 6
    assert found.mean == pytest.approx(values.mean())
    assert found.standard_error == pytest.approx(np.sqrt(((values - found.mean) ** 2).sum() / 5 / 6))
    with pytest.raises(ConfigError, match="no column 'rmm': did you mean 'meta_metric'"):
        result.mean_and_error("rmm")


def test_impossible_settings_are_refused():
    for wrong in ({"num_rollouts": 0}, {"jobs": 0}, {"limit": 0}, {"metric": "1999"}, {"temperature": -1.0}):
        with pytest.raises(ConfigError):
            EvaluateConfig(**wrong)


def test_a_name_must_be_a_file_name(data, tmp_path):
    with pytest.raises(ConfigError, match="'a/b' cannot"):
        evaluate("oracle", data, tmp_path, CONFIG, name="a/b")


def test_a_file_is_no_folder_and_a_folder_no_file_before_anything_is_simulated(data, tmp_path):
    with pytest.raises(
        ConfigError, match=r"a\.parquet is to be a folder, in which x\.parquet is written: name a folder"
    ):
        evaluate("oracle", data, tmp_path / "a.parquet", CONFIG, name="x")
    (tmp_path / "x.parquet").mkdir()
    with pytest.raises(DataError, match=r"x\.parquet is a folder, not a file: choose another .* name, or remove it"):
        evaluate("oracle", data, tmp_path, CONFIG, name="x")
    assert [path.name for path in tmp_path.iterdir()] == ["x.parquet"]


def test_a_fingerprint_follows_weights_and_settings_only():
    def build(bias=0.0, width=2):
        network = torch.nn.Linear(width, 1)
        torch.nn.init.constant_(network.weight, 1.0)
        torch.nn.init.constant_(network.bias, bias)
        return network

    assert fingerprint_policy(build()) == fingerprint_policy(build().eval())
    assert len({fingerprint_policy(p) for p in (build(), build(0.5), build(width=3), Wobble(), Wobble(2.0))}) == 5


def test_file_metadata_is_readable_without_us(data, tmp_path):
    evaluate("oracle", data, tmp_path, CONFIG, name="oracle")
    about = json.loads(pq.read_schema(tmp_path / "oracle.parquet").metadata[b"rlftsim"])
    assert about["provenance"]["policy"] == "oracle"
    assert about["provenance"]["config"]["num_rollouts"] == 4


def test_generated_scenes_and_the_oracle_are_evaluated_without_a_warning(capsys):
    generated = rs.evaluate("constant_velocity", "synthetic", metric="2025-scenario-gen", limit=1, num_rollouts=2)
    assert 0 < generated["meta_metric"][0] < 1
    oracle = rs.evaluate("oracle", "synthetic", limit=1, num_rollouts=2)
    assert oracle["min_average_displacement_error"][0] == 0
    assert "rollouts of" not in capsys.readouterr().err


def test_degrees_are_told_where_a_model_is_evaluated(data, capsys):
    class Degrees(ConstantVelocity):
        def advance(self, context, state, decision, forced=None):
            after = super().advance(context, state, decision, forced)
            after.poses[..., 2] = torch.rad2deg(after.poses[..., 2]) + 170
            return after

    evaluate(Degrees(), data, None, replace(CONFIG, limit=1), name="degrees")
    assert "rad (degrees?)" in capsys.readouterr().err
