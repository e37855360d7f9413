"""Pictures of goals: who is asked, how near is near, and colors that mean nothing else."""

import numpy as np
import pytest
from matplotlib.patches import Circle

import scenes
from rlftsim.viewer import goal_picture
from rlftsim.viewer.goal_picture import GOAL_COLORS, LONGEST_LABEL, DrawnGoal, GoalPanel, draw_goals
from rlftsim.viewer.picture import COLORS

ROAD = scenes.straight_road()


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Draws one panel and returns its axes."""
    figures = []
    monkeypatch.setattr(goal_picture, "save_figure", lambda path, figure, **_: figures.append(figure))

    def draw(*marks):
        draw_goals(tmp_path / "p.png", [GoalPanel("t", ROAD, marks)])
        return figures[-1].axes[0]

    return draw


def test_a_goal_is_a_circle_of_two_meters_with_its_agent_beside_it(drawn):
    goal = np.array([1040.0, -200.0])
    axis = drawn(DrawnGoal(100, goal, r"a $\foo$ b" + "x" * 300))
    circles = [patch for patch in axis.patches if isinstance(patch, Circle)]
    assert {circle.radius for circle in circles} == {2.0}
    np.testing.assert_allclose(circles[0].center, goal - ROAD.origin)
    names = [text for text in axis.texts if text.get_text().startswith(r"100: a $\foo$ b")]
    assert [(len(text.get_text()), text.get_parse_math()) for text in names] == [(LONGEST_LABEL + 5, False)]
    assert {"100", "101", "103"} <= {text.get_text() for text in axis.texts}  # everybody's id


def test_who_has_no_goal_is_in_the_middle(drawn):
    axis = drawn(DrawnGoal(103))
    middle = [sum(limits) / 2 for limits in (axis.get_xlim(), axis.get_ylim())]
    place = ROAD.tracks.position[ROAD.tracks.object_id == 103, 10, :2][0] - ROAD.origin
    np.testing.assert_allclose(middle, place, atol=1e-3)


def test_goals_have_no_color_of_agents():
    assert not set(GOAL_COLORS) & {COLORS[role] for role in ("ego", "evaluated", "other")}
