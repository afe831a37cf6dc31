"""The gap between green and blue equals the geometric one, and is 0 if they touch."""

import jax
import numpy as np
import pytest

from levelproof.experts.search.near import FAR, gap, goals_of
from levelproof.levelgen.level import Level, Role, concatenate_levels
from tests.experts.search.worlds import BALL, BARS, GOAL, switchback

BAR = BARS.start
GAP = jax.jit(lambda levels: gap(goals_of(levels), levels.state))


def measured(*levels: Level) -> np.ndarray:
    """Return gaps from one compiled program, padded to two levels with the last."""
    many = concatenate_levels([*levels, *[levels[-1]] * (2 - len(levels))])
    return np.asarray(GAP(many))[: len(levels)]


def goal_at(body: int, *, role: Role = Role.BLUE) -> Level:
    """Return the switchback with plain shelves, and another body in place of its goal."""
    level = switchback()
    level.role[[BAR, BAR + 1, GOAL]], level.role[body] = Role.PLAIN, role
    return level


def test_gap_of_circles_is_exact() -> None:
    assert measured(switchback()) == pytest.approx(np.hypot(4.5 - 0.6, 4.2 - 0.6) - 0.4)


def test_gap_above_the_end_of_a_long_bar_is_the_height() -> None:
    """The bar reaches from 0 to 3.6 m; its centre is farther from its end than the ball is."""
    over = goal_at(BAR)
    over.state.position[BALL, :, 0] = 0.3, 2.5
    turned = goal_at(BAR)
    turned.state.rotation[BAR], turned.state.position[BALL, :, 0] = np.pi / 2, (1.0, 2.9)
    np.testing.assert_allclose(measured(over, turned), [2.5 - 1.6 - 0.2, 1.8 - 1.0 - 0.1 - 0.2], rtol=1e-5)


def test_gap_of_touching_bodies_is_zero() -> None:
    level = goal_at(BAR)
    level.state.position[BALL, :, 0] = 1.8, 1.7
    assert measured(level) == 0


def test_gap_measures_polygons_and_triangles() -> None:
    """Bars one above the other; the fourth corner of a triangle, which means nothing, is far away."""
    bars = goal_at(BAR)
    bars.role[BALL], bars.role[BAR + 1] = Role.PLAIN, Role.GREEN
    triangle = goal_at(BAR)
    triangle.role[BALL], triangle.role[BAR + 1] = Role.PLAIN, Role.GREEN
    triangle.model.n_vertices[BAR] = 3
    triangle.model.vertices[BAR, :, :, 0] = [(0, 0.5), (0.5, -0.5), (-0.5, -0.5), (50.0, 50.0)]
    np.testing.assert_allclose(measured(bars, triangle), [3.2 - 1.5 - 0.2, 3.2 - 1.5 - 0.6], rtol=1e-5)


def test_gap_is_that_of_the_nearest_pair() -> None:
    level = goal_at(BAR)
    level.role[GOAL] = Role.BLUE
    assert measured(level) == pytest.approx(1.5 - 0.1 - 0.6 - 0.2)


def test_gap_leaves_out_pairs_that_cannot_touch() -> None:
    """A green floor and a blue wall; a ball and a blue bar whose collision modes exclude each other."""
    scenery, modes = goal_at(1), goal_at(BAR)
    scenery.role[0], scenery.role[GOAL], scenery.role[BALL] = Role.GREEN, Role.BLUE, Role.PLAIN
    modes.model.collision_mode[[BALL, BAR]], modes.role[GOAL] = [[1], [0]], Role.BLUE
    expected = measured(switchback())[0]
    assert measured(scenery)[0] > 1
    assert measured(modes)[0] == pytest.approx(expected)


def test_gap_without_a_pair_is_far() -> None:
    level = goal_at(BAR, role=Role.RED)
    assert measured(level) == pytest.approx(FAR)
    gone = goal_at(BAR)
    gone.model.active[BAR] = False
    assert measured(gone) == pytest.approx(FAR)
