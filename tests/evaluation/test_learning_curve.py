"""What a run logged, as charts."""

import json

from rlftsim.evaluation.learning_curve import finetuning_charts, imitation_charts, write_learning_curve

LINES = [
    {"update": u, "loss": 3.0 / u, "accuracy": 0.1 * u, "top5_accuracy": 0.2 * u, "entropy": 4.0 / u}
    for u in range(1, 5)
]
SCORES = {"validation_rmm": 0.6, "validation_rmm_low": 0.5, "validation_rmm_high": 0.7}


def test_a_metric_has_the_points_that_were_logged():
    lines = [*LINES[:3], {**LINES[3], **SCORES}]
    loss, accuracy, realism = imitation_charts(lines)
    assert list(loss.curves[0].y) == [3.0, 1.5, 1.0, 0.75]
    assert [list(curve.x) for curve in realism.curves] == [[4], [4], [4]]
    assert [list(curve.y) for curve in realism.curves] == [[0.6], [0.5], [0.7]]
    assert [curve.name for curve in accuracy.curves] == ["first guess", "among five"]


def test_without_validation_there_is_no_chart_of_it():
    assert [chart.title for chart in imitation_charts(LINES)] == ["Cross-entropy", "Next token right"]


def test_an_objective_of_the_policys_own_is_drawn_by_the_names_it_has(tmp_path):
    lines = [{"update": u, "time": 0.0, "loss": 3.0 / u, "goal_nll": 1.0, **SCORES} for u in (1, 2)]
    assert [chart.title for chart in imitation_charts(lines)] == ["Loss", "Goal nll", "Realism of held-out rollouts"]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert write_learning_curve(tmp_path)


def test_the_target_is_drawn_where_it_is_known():
    line = dict.fromkeys(("update", "rmm", "reward_std", "kl", "beta", "offroad_rate", "collision_rate"), 1.0)
    assert [chart.reference for chart in finetuning_charts([line], 0.05)][2] == ("target", 0.05)
    assert finetuning_charts([line])[2].reference is None


def test_a_run_is_drawn_at_any_moment(tmp_path):
    assert write_learning_curve(tmp_path) is None
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in LINES) + '{"update": 5, "lo')
    path = write_learning_curve(tmp_path)
    assert path is not None
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
