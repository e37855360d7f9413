"""A student comes nearer to its teacher, along the rollouts of both."""

import pytest
import torch

import rlftsim as rs
import scenes
import tiny
from rlftsim.cli.main import main
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.compact import CompactPolicy
from rlftsim.policies.smart.config import CompactConfig
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import collate
from rlftsim.tokens.agent_tokens import corner_distances
from rlftsim.tokens.subset import SharedTokens, choose_tokens
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.config import CalibrateConfig, DistillConfig
from rlftsim.training.distill import Lesson, judge, roll_out
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics
from rlftsim.verbs.distill import distill

NUM_TOKENS = 24


@pytest.fixture(scope="module")
def teacher(vocabulary, tmp_path_factory):
    """Folder of a teacher that stands, walks and drives with unequal probabilities."""
    policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
    with torch.no_grad():
        policy.network.decoder.head[-1].bias.copy_(torch.linspace(2.0, -2.0, vocabulary.num_tokens))
    folder = tmp_path_factory.mktemp("teacher") / "model"
    policy.save_pretrained(folder)
    return str(folder)


@pytest.fixture
def student(vocabulary, drawn_scenarios):
    torch.manual_seed(0)
    return CompactPolicy(CompactConfig(dim=8, hidden=16), choose_tokens(vocabulary, drawn_scenarios, NUM_TOKENS))


def settings(**changes):
    values = {"epochs": 3.0, "num_rollouts": 2, "steps_per_update": 2, "learning_rate": 1e-2, "ema_decay": None}
    return DistillConfig(checkpoint_every=2, device=tiny.CPU, **values | changes)


@torch.no_grad()
def divergence(policy, teacher, scenarios):
    """Mean KL to the teacher along the policy's own rollouts, nats."""
    lesson, batch = Lesson(policy.eval(), load_policy(teacher)), collate(scenarios)
    context = policy.encode(batch)
    rollouts = roll_out(lesson, batch, context, DistillConfig(num_rollouts=4), 7, is_taught=False)
    target, _ = judge(lesson, batch, rollouts)
    log_probs = policy.score(context, rollouts).log_probs
    return float(torch.nn.functional.kl_div(log_probs, target, reduction="none").sum(-1).mean())


def test_a_student_ends_nearer_to_the_teacher_than_it_began(teacher, student, drawn_scenarios, tmp_path):
    before = divergence(student, teacher, drawn_scenarios)
    train_policy(Lesson(student, load_policy(teacher)), drawn_scenarios, tmp_path, settings(epochs=4.0))
    after = divergence(student, teacher, drawn_scenarios)
    assert after < 0.5 * before  # measured 1.1 -> 0.1
    metrics = read_metrics(tmp_path)
    assert metrics[-1]["loss"] < 0.5 * metrics[0]["loss"]


@pytest.mark.parametrize("first", [1, 4])
def test_a_run_that_was_stopped_ends_as_if_it_never_was(first, teacher, student, drawn_scenarios, tmp_path):
    weights = []
    for name, stops in (("straight", ()), ("stopped", (first,))):
        for max_updates in (*stops, None):
            begun = CompactPolicy(student.config, student.vocabulary)
            begun.load_state_dict(student.state_dict())
            lesson = Lesson(begun, load_policy(teacher))
            model = train_policy(
                lesson, drawn_scenarios, tmp_path / name, settings(ema_decay=0.9), max_updates=max_updates
            )
        weights.append((model / "model.safetensors").read_bytes())
    assert weights[0] == weights[1]


@pytest.mark.parametrize("is_taught", [True, False])
def test_student_and_teacher_agree_on_every_state(is_taught, teacher, student, drawn_scenarios):
    lesson, batch = Lesson(student.eval(), load_policy(teacher)), collate(drawn_scenarios)
    loaded, tokens = lesson.teacher, lesson.tokens
    with torch.no_grad():
        rollouts = roll_out(lesson, batch, student.encode(batch), settings(), 3, is_taught=is_taught)
    class_id = class_of_type(batch.object_type)[:, None].expand(rollouts.heading.shape[:3])
    present = batch.agent_mask[:, None].expand(class_id.shape)
    for policy, ids in ((loaded, tokens.in_large), (student, torch.arange(NUM_TOKENS).expand(3, -1))):
        context = policy.encode(batch)
        state = policy.begin(context, 2, None, rollouts.log_prob[..., :0])
        for index in range(rollouts.decision.shape[-1]):
            forced: AgentStates = rollouts.forced.steps(5 * index, 5 * index + 5)
            state = policy.advance(context, state, ids[class_id, rollouts.decision[..., index]], forced)
            assert torch.equal(state.poses[present][:, -1, :2], rollouts.position[present][:, 5 * index + 4])


def test_tokens_that_are_kept_are_the_teachers_and_cover_the_others(vocabulary, drawn_scenarios):
    kept = choose_tokens(vocabulary, drawn_scenarios, NUM_TOKENS)
    tokens = SharedTokens.find(kept, vocabulary)
    assert torch.equal(kept.token_mask.sum(1), vocabulary.token_mask.sum(1).clamp(max=NUM_TOKENS))
    assert (tokens.in_large[:, 0] == 0).all()
    for index, ends in enumerate(vocabulary.end_corners()):
        is_kept, exists = kept.token_mask[index], vocabulary.token_mask[index]
        assert torch.equal(ends[tokens.in_large[index][is_kept]], kept.end_corners()[index][is_kept])
        chosen, first = kept.end_corners()[index][is_kept], ends[exists][:NUM_TOKENS]
        far, farther = (corner_distances(ends[exists], table).amin(1).mean() for table in (chosen, first))
        assert far <= farther
    everything = choose_tokens(vocabulary, drawn_scenarios, 10_000)
    assert torch.equal(everything.token_mask, vocabulary.token_mask)


def test_a_student_is_calibrated_simulated_driven_and_exported_like_any_other(teacher, student, tmp_path, capsys):
    data = rs.load_dataset("synthetic", "validation")
    student.save_pretrained(tmp_path / "student")
    calibrate = CalibrateConfig(num_scenarios=2, num_rollouts=2, lengths=(1.0,), micro_batch_size=1, device=tiny.CPU)
    calibrated = rs.finetune(str(tmp_path / "student"), [data[0], data[7]], tmp_path / "tuned", calibrate)
    assert isinstance(calibrated, CalibratedTokenPolicy)
    assert rs.simulate(calibrated, data[7], num_rollouts=2, seed=0).position.isfinite().all()
    common = ["--data", "synthetic", "--limit", "1"]
    assert main(["drive", "idm", "--model", str(tmp_path / "tuned"), *common, "--out", str(tmp_path / "drives")]) == 0
    words = ["simulate", str(tmp_path / "student"), *common, "--num-rollouts", "2", "--out", str(tmp_path / "rollouts")]
    assert main(words) == 0
    assert main(["model", "export", str(tmp_path / "student"), str(tmp_path / "s.safetensors")]) == 2
    assert "SMART" in capsys.readouterr().err
    words = ["export", "page", str(tmp_path / "rollouts"), str(tmp_path / "pages"), "--data", "synthetic"]
    assert main(words) == 0


def test_mistakes_are_one_clear_line(teacher, student, drawn_scenarios, tmp_path, capsys):
    assert main(["distill", "constant_velocity", "--data", "synthetic", "--limit", "1", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert (
        "a ConstantVelocity has no vocabulary, so there are no tokens to distill: name a teacher that chooses tokens"
        in error
    )
    assert len(error.splitlines()) == 1
    with pytest.raises(ConfigError, match="neither a model folder"):
        distill("demo-tunde", drawn_scenarios, tmp_path)
    with pytest.raises(ConfigError, match="a CompactPolicy needs a teacher to be distilled: rlftsim distill TEACHER"):
        train_policy(student, drawn_scenarios, tmp_path, settings())
    foreign = tiny.small_vocabulary([scenes.crowd(num_agents=12)])
    with pytest.raises(ConfigError, match="tokens that the teacher lacks"):
        Lesson(CompactPolicy(student.config, foreign), load_policy(teacher))
    with pytest.raises(ConfigError, match="teacher_share"):
        settings(teacher_share=2.0)


def test_a_folder_of_another_teacher_is_refused(teacher, student, vocabulary, drawn_scenarios, tmp_path):
    train_policy(Lesson(student, load_policy(teacher)), drawn_scenarios, tmp_path, settings(), max_updates=1)
    other = Lesson(CompactPolicy(student.config, student.vocabulary), tiny.tiny_policy(vocabulary, seed=9))
    with pytest.raises(CheckpointError, match="teacher"):
        train_policy(other, drawn_scenarios, tmp_path, settings())


def test_the_verb_makes_a_student_of_any_model(teacher, drawn_scenarios, monkeypatch):
    monkeypatch.setattr(
        "rlftsim.policies.smart.compact.STUDENTS", {"small": (CompactConfig(dim=8, hidden=16), NUM_TOKENS)}
    )
    student = distill(teacher, drawn_scenarios[:2], epochs=1.0, processes=1)
    assert rs.simulate(student, drawn_scenarios[0], num_rollouts=2, seed=0).position.isfinite().all()
    again = distill(load_policy(teacher), drawn_scenarios[:2], epochs=1.0, processes=1)
    assert fingerprint_policy(again) == fingerprint_policy(student)


def test_a_student_cut_short_is_a_model_and_learns_on_to_equal_weights(teacher, drawn_scenarios, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "rlftsim.policies.smart.compact.STUDENTS", {"small": (CompactConfig(dim=8, hidden=16), NUM_TOKENS)}
    )
    whole = distill(teacher, drawn_scenarios[:2], epochs=2.0, processes=1)
    short = distill(teacher, drawn_scenarios[:2], tmp_path, epochs=2.0, max_updates=1, processes=1)
    assert fingerprint_policy(load_policy(tmp_path)) == fingerprint_policy(short) != fingerprint_policy(whole)
    longer = distill(teacher, drawn_scenarios[:2], tmp_path, epochs=2.0, processes=1)
    assert fingerprint_policy(longer) == fingerprint_policy(whole)
