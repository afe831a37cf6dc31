"""Polishing finds the shortest success of a level in which it is known, and depends on the level alone."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import ExpertConfig
from levelproof.experts.labels import Source
from levelproof.experts.pool.rework import IN_CACHE, rework
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.play import arena, code_of
from levelproof.experts.search.shorten import LANES, Shortened, polish, replayed
from levelproof.experts.verdict.judge import repeating
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import replay, steps_to_goal
from levelproof.levelgen.batching import at_once, take
from levelproof.levelgen.level import ACTIONS, MOTOR_BINDINGS, Level, Role
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.search.worlds import world

pytestmark = pytest.mark.slow

WIDTH = at_once(LANES, IN_CACHE)  # levels that one program polishes
IDS = np.arange(WIDTH, dtype=np.int32)
ENV_STEPS = 60_000
RIGHT = MOTOR_BINDINGS  # entry of the action that the first thruster obeys
IDLE, WASTED = 40, 20  # env steps of the success that is given


@cache
def levels() -> Level:
    """Return a ball on a line without friction, which one thruster pushes to the goal and another away from it."""
    level = world(bars=[((2.5, 0.2), (2.5, 0.1), 0.0)] * 2, bar_role=Role.PLAIN, ball=(1.0, 2.5), goal=(4.0, 2.5),
                  angles=(0.0, np.pi), thrust=0.4)  # fmt: skip
    level.model.gravity[:] = 0
    level.model.friction[:] = 0
    return take(level, np.zeros(WIDTH, int))


def constant(entry: int, choice: int) -> np.ndarray:
    action = np.zeros((256, ACTIONS), np.int8)
    action[:, entry] = choice
    return action


@cache
def shortest() -> tuple[np.ndarray, int]:
    """Return the better constant push and its length; no actions are faster."""
    ways = [constant(entry, 1) for entry in (RIGHT, RIGHT + 1)]
    record = replay(take(levels(), np.zeros(2, int)), np.stack(ways, -1))
    steps = np.where(record.goal.any(0), steps_to_goal(record.goal), 257)
    return ways[int(steps.argmin())], int(steps.min())


@cache
def given() -> Success:
    """Return actions that wait, then push."""
    action, steps = shortest()
    late = np.concatenate([np.zeros((IDLE, ACTIONS), np.int8), action[:-IDLE]])
    late[IDLE + steps :] = 0
    return Success(np.stack([late] * WIDTH), np.full(WIDTH, IDLE + steps, np.int32))  # pyright: ignore


@cache
def polished() -> Shortened:
    return jax.device_get(polish(levels(), IDS, given(), ENV_STEPS, DEFAULT_RULES))


def test_polish_finds_the_shortest_success() -> None:
    success, length = polished().success
    np.testing.assert_array_equal(length, shortest()[1])
    record = replay(levels(), np.moveaxis(np.asarray(success), 0, -1))
    np.testing.assert_array_equal(steps_to_goal(record.done), length)
    assert record.goal[length[0] - 1].all()
    assert not success[:, length[0] :].any()


def test_polish_depends_on_the_level_alone() -> None:
    at = np.array([2, 0, 0, *range(WIDTH - 3)])
    again = polish(levels(), IDS[at], given(), ENV_STEPS, DEFAULT_RULES)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(again), jax.tree.map(lambda x: x[at], polished()))


def test_env_steps_are_limited() -> None:
    steps = polished().env_steps
    assert (steps >= ENV_STEPS).all()
    assert (steps < ENV_STEPS + LANES * 256).all()
    none = Success(given().action, np.array([0, *given().length[1:]], np.int32))  # pyright: ignore
    few = polish(levels(), IDS, none, ENV_STEPS, DEFAULT_RULES)
    assert few.env_steps[0] == 0
    assert few.success.length[0] == 0
    np.testing.assert_array_equal(few.success.length[1:], polished().success.length[1:])


def test_replays_end_once_enough_lanes_have_reached_the_goal() -> None:
    """The first ones are the same as when all lanes play to the end; the others count as failures."""
    (action, steps), level = shortest(), take(levels(), np.zeros(1, int))
    waits = np.array([9, 2, 5, 0, 7, 2, 4, 30])
    late = np.stack([np.concatenate([np.zeros((wait, ACTIONS), np.int8), action[: 256 - wait]]) for wait in waits])
    code = code_of(Success(late, np.full(len(waits), 256, np.int32)))[None]  # pyright: ignore
    ring, most = arena(level, len(waits), (1.0,)), jnp.array([steps + waits[0]])
    run = jax.jit(lambda enough: replayed(ring, code, most, DEFAULT_RULES, enough, measured=True))
    whole, near = run(len(waits))
    np.testing.assert_array_equal(whole[0], np.where(waits < 30, steps + waits, 257))
    np.testing.assert_array_equal(near[0] > 0, waits == 9)  # it takes as long as is allowed
    for enough, counted in (1, [3]), (2, [1, 3, 5]):
        early, near = run(enough)
        np.testing.assert_array_equal(np.flatnonzero(early[0] <= 256), counted)
        np.testing.assert_array_equal(early[0, counted], whole[0, counted])
        assert not near.any()


def test_run_polishes_witnesses() -> None:
    """A witness that does nothing stays."""
    asked = SearchConfig(polish=ENV_STEPS, robustness=0)
    procedure = Procedure(search=asked, expert=ExpertConfig(replays=0))
    rough = [witness for pair in zip(*given(), strict=True) for witness in repeating(Success(*pair), Source.SAMPLED)]
    rough[0] = rough[0]._replace(source=Source.NOTHING)
    witnesses, env_steps = rework(levels(), IDS, [*rough[:-1], None], procedure, DEFAULT_RULES)
    assert witnesses[0] is rough[0]
    assert witnesses[-1] is None
    assert env_steps.tolist() == [0, *polished().env_steps[1:-1], 0]
    for i, witness in enumerate(witnesses[1:-1], 1):
        assert witness is not None
        assert (witness.steps, witness.source) == (shortest()[1], Source.SEARCH)
        np.testing.assert_array_equal(witness.action[: witness.steps], polished().success.action[i, : witness.steps])
