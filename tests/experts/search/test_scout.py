"""Persistent random play: what it finds is true, depends on the level alone, and is played as said."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import RECORD_STEPS, Rule, ScoutConfig, StopConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.search.scout import REDRAWN, STEPS_PER_ROUND, Scouted, persistent, scout, shortest
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.small import IDS, untouched

TWICE = ScoutConfig(rounds=2)


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def found(levels: Level) -> Scouted:
    return scout(levels, IDS, TWICE, DEFAULT_RULES)


def test_what_is_found_reaches_the_goal(levels: Level, found: Scouted) -> None:
    length = found.success.length
    assert 0 < (length > 0).sum() < len(IDS), "these levels should show both"
    record = replay(levels, np.moveaxis(found.success.action, 0, -1))
    for i in np.flatnonzero(length):
        assert record.goal[length[i] - 1, i]
        assert not record.done[: length[i] - 1, i].any()
    afterwards = np.arange(RECORD_STEPS) >= length[:, None]
    assert not found.success.action[afterwards].any()


def test_what_nothing_obeys_is_not_used(levels: Level, found: Scouted) -> None:
    dead = ~np.asarray(action_mask(levels)).T
    assert dead.any()
    assert not np.moveaxis(found.success.action, 1, -1)[dead].any()


def test_a_level_leaves_after_the_round_that_finds_something(levels: Level, found: Scouted) -> None:
    once = scout(levels, IDS, ScoutConfig(rounds=1), DEFAULT_RULES)
    assert set(once.env_steps.tolist()) == {STEPS_PER_ROUND}
    early = once.success.length > 0
    np.testing.assert_array_equal(found.env_steps, np.where(early, 1, 2) * STEPS_PER_ROUND)
    np.testing.assert_array_equal(found.success.action[early], once.success.action[early])
    nothing = scout(levels, IDS, ScoutConfig(rounds=0), DEFAULT_RULES)
    assert not nothing.success.length.any()
    assert not nothing.env_steps.any()


@pytest.mark.parametrize("at", [[6], [5, 0, 3, 6, 1]])
def test_it_depends_on_the_level_alone(levels: Level, found: Scouted, at: list[int]) -> None:
    some = scout(take(levels, np.array(at)), IDS[at], TWICE, DEFAULT_RULES)
    jax.tree.map(np.testing.assert_array_equal, some, jax.tree.map(lambda x: x[np.array(at)], found))


def test_an_entry_is_drawn_anew_as_often_as_said() -> None:
    lanes = 100_000
    bits = jax.random.bits(jax.random.key(0), (6, lanes), jnp.uint32)
    never, every = jnp.zeros(lanes, bool), jnp.ones(lanes, bool)
    last = jnp.full((6, lanes), -1)
    drawn = np.asarray(persistent(last, bits, jnp.zeros(lanes), every))
    for entry, choices in zip(drawn, CHOICES, strict=True):
        np.testing.assert_allclose(np.bincount(entry) / lanes, np.full(choices, 1 / choices), atol=0.01)
    for chance in REDRAWN:
        kept = np.asarray(persistent(last, bits, jnp.full(lanes, chance), never)) == -1
        np.testing.assert_allclose(kept.mean(), 1 - chance, atol=0.005)


def test_the_shortest_success_counts() -> None:
    action = np.arange(RECORD_STEPS)[:, None, None] + np.zeros((1, 6, 3), int)
    goal, timestep = np.zeros((RECORD_STEPS, 3), bool), np.zeros((RECORD_STEPS, 3), int)
    for step, lane, length in ((99, 0, 100), (40, 1, 11), (80, 2, 11), (200, 1, 60)):
        goal[step, lane], timestep[step, lane] = True, length - 1
    played = jnp.asarray(action, jnp.uint8)
    best = shortest(played, jnp.asarray(goal), jnp.asarray(timestep))
    assert int(best.length) == 11
    np.testing.assert_array_equal(best.action[:12, 0], [*range(30, 41), 0])
    assert int(shortest(played, jnp.zeros(goal.shape, bool), jnp.asarray(timestep)).length) == 0


def test_without_experts_labels_rest_on_what_was_found(levels: Level, found: Scouted) -> None:
    procedure = replace(untouched(StopConfig(rule=Rule.NONE)), scout=TWICE)
    result = label(levels, IDS, 1024, procedure)
    for verdict, length, steps in zip(result.verdicts, found.success.length, found.env_steps, strict=True):
        assert verdict.label is (Label.SOLVED if length else Label.UNSOLVED)
        assert verdict.witness is (Source.SCOUT if length else None)
        assert verdict.steps_to_goal == (length or None)
        assert (verdict.env_steps, verdict.scout_steps, verdict.learning_curve) == (0, steps, [])
    assert result.spent.scouted == found.env_steps.sum()
    assert result.spent.trained == result.spent.idle == 0
