"""Stopping rules."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import MAX_DOUBLINGS, ExpertConfig, Rule, StopConfig, check_budget
from levelproof.experts.labels import Cause
from levelproof.experts.training import progress, stop
from levelproof.experts.training.stop import rules_of

CONFIG = ExpertConfig(
    environments=16, horizon=64, attempts=8, sticky_attempts=4, perturbed_attempts=4
)  # 1024 env steps an update
SOLVED, HALVING = StopConfig(wait=2048, share=0.9), StopConfig(rule=Rule.HALVING, first_rung=4096, gain=0.1)


def after(updates: int, share: float, stopping: StopConfig, best: float = 0.0, first: int = progress.NEVER, **course):
    now = stop.begin()._replace(updates=jnp.int32(updates - 1), **course)
    totals = progress.start(16)._replace(best_return=jnp.float32(best), first_success=jnp.int32(first))
    usable, share_, deadline = jnp.bool_(first != progress.NEVER), jnp.float32(share), jnp.int32(100)
    now, due, final = stop.after_update(now, totals, usable, share_, deadline, rules_of(stopping, CONFIG))
    assert int(now.updates) == updates
    assert bool(now.over) == (bool(final) and updates < 100)
    return now, bool(due), bool(final)


@pytest.mark.parametrize("stopping", [StopConfig(rule=Rule.BUDGET), SOLVED, HALVING])
def test_budget_ends_in_an_evaluation(stopping: StopConfig) -> None:
    assert after(99, float("nan"), stopping)[1:] == (False, False)
    assert after(100, float("nan"), stopping)[1:] == (False, True)


def test_successes_in_training_trigger_an_evaluation() -> None:
    assert after(7, 0.95, SOLVED)[1:] == (True, False)
    assert after(7, 0.85, SOLVED)[1:] == (False, False)
    assert after(7, 1.0, SOLVED, next_evaluation=jnp.int32(8))[1:] == (False, False)
    assert after(7, 1.0, StopConfig(rule=Rule.BUDGET))[1:] == (False, False)


@pytest.mark.parametrize("stopping", [StopConfig(rule=Rule.BUDGET), SOLVED, HALVING])
def test_diverged_expert_leaves(stopping: StopConfig) -> None:
    totals = progress.start(16)._replace(diverged=jnp.int32(1024))
    course, _, final = stop.after_update(
        stop.begin(),
        totals,
        jnp.bool_(False),
        jnp.float32(0.0),
        jnp.int32(100),
        rules_of(stopping, CONFIG),
    )
    assert (bool(final), int(course.over)) == (True, Cause.DIVERGED)


def test_expert_stopped_at_a_rung_by_its_last_update_is_over_for_any_budget() -> None:
    totals, course = progress.start(16), stop.begin()._replace(updates=jnp.int32(7), rung_return=jnp.float32(0.5))
    course, _, final = stop.after_update(
        course, totals, jnp.bool_(False), jnp.float32(0.0), jnp.int32(8), rules_of(HALVING, CONFIG)
    )
    assert (bool(final), int(course.over)) == (True, Cause.RUNG)


def test_rung_stops_experts_whose_return_has_not_grown() -> None:
    """Rungs are at 4, 8, 16, 32 and 64 updates."""
    low = jnp.float32(0.5)
    assert after(8, 0.0, HALVING, best=0.55, rung_return=low)[1:] == (False, True)
    moved, evaluate, final = after(8, 0.0, HALVING, best=0.65, rung_return=low)
    assert (evaluate, final, float(moved.rung_return)) == (False, False, pytest.approx(0.65))
    assert after(8, 0.0, HALVING, best=0.55, rung_return=low, first=77)[1:] == (False, False)
    between, evaluate, final = after(12, 0.0, HALVING, best=0.55, rung_return=low)
    assert (evaluate, final, float(between.rung_return)) == (False, False, 0.5)


@pytest.mark.parametrize(
    ("updates", "first", "stopping", "leaves"),
    [
        (19, progress.NEVER, HALVING, False),
        (20, progress.NEVER, HALVING, True),
        (20, 77, HALVING, False),
        (20, progress.NEVER, replace(HALVING, fruitless=0), False),
        (20, progress.NEVER, replace(HALVING, rule=Rule.SOLVED), False),
    ],
)
def test_expert_that_never_reaches_the_goal_leaves(
    updates: int, first: int, stopping: StopConfig, leaves: bool
) -> None:
    """The expert leaves after 20 updates, even if it rehearses a success, and whether or not at a rung."""
    stopping = replace(stopping, fruitless=stopping.fruitless and 20_480)
    course, totals = stop.begin()._replace(updates=jnp.int32(updates - 1)), progress.start(16)
    totals, given = totals._replace(first_success=jnp.int32(first)), jnp.bool_(True)
    course, _, final = stop.after_update(
        course, totals, given, jnp.float32(0.0), jnp.int32(100), rules_of(stopping, CONFIG)
    )
    assert (bool(final), int(course.over)) == (leaves, Cause.FRUITLESS if leaves else Cause.NONE)


def test_is_rung_accepts_powers_of_two_of_the_first() -> None:
    assert [u for u in range(1, 200) if bool(stop.is_rung(jnp.int32(u), 3))] == [3, 6, 12, 24, 48, 96, 192]


def test_after_evaluation_decides_who_leaves_and_when_to_evaluate_next() -> None:
    course = stop.begin()._replace(updates=jnp.int32(10))
    decide = lambda solved, final, stopping: stop.after_evaluation(
        course,
        jnp.bool_(solved),
        jnp.bool_(not final),
        jnp.bool_(final),
        jnp.int32(100),
        rules_of(stopping, CONFIG),
    )
    failed, leaves, deadline = decide(False, False, SOLVED)
    assert (int(failed.next_evaluation), bool(leaves), int(deadline)) == (12, False, 100)
    assert bool(decide(True, False, SOLVED)[1])
    assert bool(decide(False, True, SOLVED)[1])
    polished, leaves, deadline = decide(True, False, replace(SOLVED, polish=5 * 1024))
    assert (bool(polished.solved), bool(leaves), int(deadline)) == (True, False, 15)
    assert int(decide(True, False, replace(SOLVED, polish=1))[2]) == 11, "less than an update is an update"


@pytest.mark.parametrize("failed", [0, 1, 5, MAX_DOUBLINGS, MAX_DOUBLINGS + 1, 100])
def test_wait_doubles_with_each_failed_evaluation_up_to_a_limit(failed: int) -> None:
    course, yes, no = stop.begin()._replace(failed=jnp.int32(failed)), jnp.bool_(True), jnp.bool_(False)
    tried, _, _ = stop.after_evaluation(course, no, yes, no, jnp.int32(10**6), rules_of(SOLVED, CONFIG))
    assert int(tried.next_evaluation) == 2 * 2 ** min(failed, MAX_DOUBLINGS)
    assert int(tried.failed) == failed + 1


def test_final_evaluation_leaves_no_trace_in_a_continued_expert() -> None:
    """A larger budget continues as if that evaluation had not happened."""
    course = stop.begin()._replace(updates=jnp.int32(10), next_evaluation=jnp.int32(9))
    yes, no = jnp.bool_(True), jnp.bool_(False)
    ended, leaves, _ = stop.after_evaluation(course, no, no, yes, jnp.int32(10), rules_of(SOLVED, CONFIG))
    assert bool(leaves)
    np.testing.assert_equal(tuple(map(np.asarray, ended)), tuple(map(np.asarray, course)))
    due, _, _ = stop.after_evaluation(course, no, yes, yes, jnp.int32(10), rules_of(SOLVED, CONFIG))
    assert (int(due.failed), int(due.next_evaluation)) == (1, 12), "it would have been made with more budget, too"


def test_solves_and_fails_count_attempts() -> None:
    rules = rules_of(StopConfig(successes=7), CONFIG)
    done = np.zeros((256, 16), bool)
    goal = done.copy()
    done[[9, 255]] = goal[[9, 255]] = True
    goal[255, 7:] = False  # one of the attempts, and all that are sticky or perturbed
    assert bool(stop.solves(done, goal, rules, CONFIG))
    assert not bool(stop.fails(done, goal, 256, rules, CONFIG))
    goal[255, 1] = False
    assert not bool(stop.solves(done, goal, rules, CONFIG))
    assert bool(stop.fails(done, goal, 256, rules, CONFIG))
    assert not bool(stop.fails(done, goal, 255, rules, CONFIG)), "what follows is of an earlier evaluation"
    assert not bool(stop.solves(done & False, goal & False, rules, CONFIG)), "no episode has ended"


def test_steps_after_the_record_decide_nothing() -> None:
    """Rollouts of an evaluation extend beyond the record if the horizon does not divide it."""
    done, goal = np.zeros((2, 300, 16), bool)
    done[50] = goal[50] = done[280] = True  # all reach the goal within the record, and fail after it
    rules = rules_of(StopConfig(successes=8), CONFIG)
    assert bool(stop.solves(done, goal, rules, CONFIG))
    assert not bool(stop.fails(done, goal, 300, rules, CONFIG))


def test_check_budget_rejects_more_successes_than_attempts() -> None:
    for rule in (Rule.SOLVED, Rule.HALVING):
        with pytest.raises(ValueError, match=r"stop.successes is 9, more than expert.attempts=8: lower it"):
            check_budget(10_000, CONFIG, StopConfig(rule=rule, successes=9))
    check_budget(10_000, CONFIG, StopConfig(rule=Rule.BUDGET, successes=9))
