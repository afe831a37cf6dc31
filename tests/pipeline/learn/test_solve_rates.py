"""Solve rates, and the intervals over levels that they come with."""

import numpy as np
import pytest

from levelproof.pipeline.learn.solve_rates import difference, interval, solve_rates


def test_intervals_are_over_levels() -> None:
    once = np.arange(100)[:, None] < 40
    assert np.allclose(interval(once), (0.3094, 0.4980), atol=1e-4)  # Wilson's, from a table
    same = np.repeat(once, 8, axis=1)  # attempts that tell nothing new narrow nothing
    assert np.allclose(interval(same), interval(once), atol=0.01)


@pytest.mark.parametrize(("share", "levels"), [(0.02, 30), (0.98, 30), (0.05, 10), (0.4, 100)])
def test_intervals_hold_the_rate_as_often_as_they_say(share: float, levels: int) -> None:
    """Sample levels of which `share` are always solved and the others never."""
    rng = np.random.default_rng(0)
    drawn = np.repeat(rng.random((500, levels, 1)) < share, 4, axis=2)
    held = [low <= share <= high for low, high in map(interval, drawn)]
    assert np.mean(held) > 0.93


def test_interval_of_levels_that_are_alike_contains_their_rate() -> None:
    low, high = interval(np.tile([True, False], (20, 4)))
    assert low < 0.5 < high


def test_worst_tenth_is_rated_on_other_attempts_than_chose_it() -> None:
    """If all levels are alike, the worst tenth is as good as the rest."""
    solved = np.random.default_rng(0).random((4000, 8)) < 0.5
    assert abs(solve_rates(solved, None)["worst"]["rate"] - 0.5) < 0.04
    assert solved[np.argsort(solved.mean(1))[:400]].mean() < 0.25


def test_worst_tenth_has_all_levels_that_tie_with_its_last() -> None:
    """The order of levels that tie does not matter."""
    hopeless = np.zeros((300, 4), bool)
    chosen = np.tile([False, False, True, True], (100, 1))  # not solved by the attempts that choose
    easy = np.ones((600, 4), bool)
    for levels in (hopeless, chosen, easy), (easy, chosen, hopeless):
        worst = solve_rates(np.concatenate(levels), None)["worst"]
        assert (worst["rate"], worst["levels"]) == (0.25, 400)
    assert solve_rates(np.concatenate([hopeless[:10], easy[:90]]), None)["worst"]["levels"] == 10


def test_difference_is_over_levels_and_narrower_than_the_players_intervals() -> None:
    rng = np.random.default_rng(0)
    skill = rng.random((2000, 1)) < 0.5  # whether anyone solves the level
    ours, theirs = ((rng.random((2000, 8)) < share) & skill for share in (0.9, 0.85))
    apart = difference(ours, theirs)
    low, high = apart["interval"]
    assert abs(apart["rate"] - 0.025) < 0.01
    assert 0 < low < apart["rate"] < high
    assert high - low < 0.5 * (interval(ours)[1] - interval(ours)[0])
    assert difference(theirs, ours)["interval"] == [-high, -low]
    few = difference(np.ones((4, 8), bool), np.zeros((4, 8), bool))
    assert few["interval"][0] < 0.6, "four levels tell little"


@pytest.mark.parametrize(("ours", "theirs"), [(0.5, 0.5), (0.9, 0.7), (0.1, 0.15)])
def test_intervals_of_differences_hold_the_difference_as_often_as_they_say(ours: float, theirs: float) -> None:
    rng = np.random.default_rng(0)
    share, held = np.linspace(0, 1, 10001), []
    expected = np.subtract(*(np.clip(2 * share * x, 0, 1).mean() for x in (ours, theirs)))
    for _ in range(400):
        skill = rng.random((60, 1))
        pair = [rng.random((60, 4)) < np.clip(2 * skill * x, 0, 1) for x in (ours, theirs)]
        low, high = difference(*pair)["interval"]
        held.append(low <= expected <= high)
    assert np.mean(held) > 0.93


def test_steps_are_those_of_attempts_that_reach_the_goal() -> None:
    steps = np.array([[10, 256], [30, 256]])
    assert solve_rates(np.array([[True, False], [True, False]]), steps)["steps"] == 20
    assert solve_rates(np.zeros((2, 2), bool), steps)["steps"] is None
