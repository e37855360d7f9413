"""A vocabulary by rule: grids, smoothing, curves."""

from dataclasses import replace

import numpy as np
import pytest

from rlftsim.errors import ConfigError
from rlftsim.tokens.trajtok import Grid, GridMotions, TrajTokConfig, rule_tokens, smooth_cells

GRID = Grid(x_min_m=-1.0, x_max_m=4.0, x_bins=50, y_max_m=1.0, y_bins=20, min_motions=1)
CONFIG = TrajTokConfig()


def motions_to(*ends: tuple[float, float, float]) -> np.ndarray:
    """Even motions from the origin to poses."""
    return (np.linspace(0, 1, 6)[None, :, None] * np.array(ends)[:, None]).astype(np.float32)


def all_around(heading: float = 0.0, *, leave_out: tuple[int, int] | None = None) -> np.ndarray:
    """A motion to every cell of a block of 11 x 11, x from 1 to 2 m, y from -0.5 to 0.5 m."""
    cells = [(i, j) for i in range(11) for j in range(-5, 6) if (i, j) != leave_out]
    return motions_to(*[(1.0 + 0.1 * i, 0.1 * j, heading * np.sign(j)) for i, j in cells])


def tokens_of(motions: np.ndarray, config: TrajTokConfig = CONFIG) -> np.ndarray:
    cells = GridMotions(GRID)
    cells.add(motions)
    return rule_tokens(cells, config)


def test_the_published_grids_are_the_defaults_and_symmetric():
    shapes = [grid.shape for grid in CONFIG.grids]
    assert shapes == [(251, 81), (121, 81), (181, 41)]
    assert [s for grid in CONFIG.grids for s in grid.spacing_m] == pytest.approx([0.1, 0.0625, 0.05, 0.05, 0.05, 0.05])
    assert [grid.min_motions for grid in CONFIG.grids] == [3, 1, 1]


def test_token_0_stands_exactly_still_and_ends_lie_on_the_grid():
    tokens = tokens_of(all_around())
    assert not tokens[0].any()
    ends = tokens[1:, -1, :2] / 0.1
    np.testing.assert_allclose(ends, np.round(ends), atol=1e-4)


def test_left_and_right_are_exactly_the_same():
    tokens = tokens_of(all_around(0.2)[::2])
    own = {t.tobytes() for t in tokens + 0.0}
    assert own == {t.tobytes() for t in tokens * np.array([1, -1, -1], np.float32) + 0.0}


def test_lonely_cells_go_and_holes_are_filled():
    used = np.zeros((30, 30), bool)
    used[5:16, 5:16] = True
    used[10, 10] = False
    used[25, 25] = True
    kept = smooth_cells(used, CONFIG)
    assert kept[10, 10]  # 80 around it
    assert not kept[25, 25]  # none around it
    assert kept[5, 5]  # a corner of the block has 5 * 5 - 1 = 24 around it
    assert not kept[3, 3]  # 3 * 3 = 9: not more than 20
    assert kept[4, 10]  # 9 * 4 - 1 (the hole is farther) = 36 or 35


@pytest.mark.parametrize(("around", "stays"), [(19, False), (20, True)])
def test_twenty_neighbors_keep_a_cell(around, stays):
    used = np.zeros((9, 9), bool)
    used.flat[:around] = True
    used[4, 4] = True
    assert smooth_cells(used, CONFIG)[4, 4] == stays


@pytest.mark.parametrize(("around", "added"), [(20, False), (21, True)])
def test_more_than_twenty_neighbors_add_a_cell(around, added):
    used = np.zeros((9, 9), bool)
    used.flat[:around] = True
    assert smooth_cells(used, CONFIG)[4, 4] == added


def test_an_added_cell_ends_with_its_neighbors_heading_and_is_under_way_at_both_ends():
    tokens = tokens_of(all_around(0.3, leave_out=(5, 3)))
    [made] = tokens[np.abs(tokens[:, -1, :2] - (1.5, 0.3)).max(1) < 1e-4]
    assert made[-1, 2] == pytest.approx(0.3, abs=1e-5)
    steps = np.hypot(*np.diff(made[:, :2], axis=0).T)
    assert steps.min() > 0.6 * steps.max()  # neither starts nor ends at rest
    leaves = np.arctan2(*np.diff(made[-2:, :2], axis=0)[0][::-1])
    assert 0.15 < leaves < 0.35  # along its end heading; the chord's direction is 0.2


def test_a_seen_cell_keeps_the_shape_of_its_motions():
    late = all_around()
    late[:, 1:5, 0] *= 0.5
    tokens = tokens_of(late)
    [made] = tokens[np.abs(tokens[:, -1, :2] - (1.5, 0.0)).max(1) < 1e-4]
    np.testing.assert_allclose(made[:, 0], [0, 0.15, 0.3, 0.45, 0.6, 1.5], atol=1e-4)


def test_a_mean_that_turns_sharply_is_made_by_rule():
    sharp = all_around(0.5)
    sharp[:, 1:5, 2] = 0.0
    tokens = tokens_of(sharp)
    assert np.abs(np.diff(tokens[..., 2])).max() < np.deg2rad(10)
    assert np.abs(tokens[:, -1, 2]).max() == pytest.approx(0.5, abs=1e-5)


def test_motions_outside_the_grid_are_not_counted():
    cells = GridMotions(GRID)
    cells.add(motions_to((9.0, 0.0, 0.0), (1.0, 3.0, 0.0), (-2.0, 0.0, 0.0)))
    assert not cells.count.any()


@pytest.mark.parametrize("changes", [{"x_min_m": 1.0}, {"y_bins": 21}, {"x_bins": 7}, {"y_max_m": 0.0}])
def test_impossible_grids_are_refused(changes):
    with pytest.raises(ConfigError):
        replace(GRID, **changes)
    with pytest.raises(ConfigError, match="odd"):
        TrajTokConfig(neighborhood=8)
