"""Variations turn near misses into successes, and results depend on the level alone."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.search.archive import Archive, ReachedStates
from levelproof.experts.search.config import NEAREST, SearchConfig
from levelproof.experts.search.edit import Draws, draw, edited
from levelproof.experts.search.explore import NEARER
from levelproof.experts.search.near import FAR, gap
from levelproof.experts.search.play import act, arena, decode, encode, fresh_walk, success_of
from levelproof.experts.search.search import Searching, side_by_side
from levelproof.experts.search.vary import (
    CHANGES,
    Approaches,
    Varying,
    begin,
    change_of,
    changed,
    first_of,
    nearest_of,
    under_way,
    vary,
)
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import ACTIONS, MOTOR_BINDINGS, Level, concatenate_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.search.worlds import broken, cannon

CONFIG = SearchConfig(env_steps=2048, variations=131_072, patience=0, lanes=32, entries=128)
WIDTH = side_by_side(CONFIG)
BROKEN = np.arange(WIDTH) % 4 == 3
IDS = np.arange(40, 40 + WIDTH, dtype=np.int32)
ROUND = CONFIG.steps_per_round  # env steps


@cache
def levels() -> Level:
    return take(concatenate_levels([cannon(), broken()]), BROKEN.astype(int))


def misses() -> Approaches:
    """Return trajectories of each level: shots into the wall."""
    action = np.zeros((ACTIONS, 256), int)
    action[MOTOR_BINDINGS, :8] = 1
    code = np.broadcast_to(encode(jnp.array(action)), (WIDTH, NEAREST, 256)).copy()
    steps = np.full((WIDTH, NEAREST), 48, np.int32)
    return Approaches(code, np.full(steps.shape, FAR, np.float32), steps)  # pyright: ignore


def begun() -> Varying:
    return begin(levels(), IDS, misses(), CONFIG)


@cache
def ended() -> Varying:
    now = begun()
    while np.asarray(under_way(now, CONFIG.ends)).any():
        now = vary(now, CONFIG, DEFAULT_RULES)
    return jax.device_get(now)


def test_variations_turn_near_misses_into_successes() -> None:
    """Successes replay: the goal at the last step, no end before. A broken world has none."""
    end, length = ended(), ended().length
    assert (length[~BROKEN] > 0).all()
    assert (length[BROKEN] == 0).all()
    assert (end.gap[BROKEN] == FAR).all()
    success = success_of(jnp.array(end.code), jnp.array(length))
    at = np.flatnonzero(length)
    record = replay(take(levels(), at), np.moveaxis(np.asarray(success.action)[at], 0, -1))
    np.testing.assert_array_equal(np.argmax(record.done, axis=0) + 1, length[at])
    assert record.goal[length[at] - 1, np.arange(len(at))].all()


@pytest.mark.slow
def test_search_runs_variations_after_go_explore() -> None:
    """Go-Explore is too short to succeed, then variations follow; both count their env steps."""
    searching = Searching(CONFIG, DEFAULT_RULES)
    job = searching.submit(levels(), IDS)
    while searching.step():
        pass
    result = searching.result(job)
    assert (np.asarray(result.success.length)[~BROKEN] > 0).all()
    steps = CONFIG.rounds * CONFIG.steps_per_round
    assert (np.asarray(result.env_steps)[BROKEN] == steps).all()
    assert (result.varied[BROKEN] >= CONFIG.variations).all()
    assert (result.varied % ROUND == 0).all()
    assert job.env_steps == sum(steps.sum() for steps in (result.env_steps, result.varied, result.shortened))


@pytest.mark.slow
def test_nearest_trajectories_replay_to_their_gaps() -> None:
    """Each trajectory has its smallest gap at its step; all are distinct, the nearest first."""
    now = begun()
    for _ in range(2):
        now = vary(now, CONFIG, DEFAULT_RULES)
    nearest = jax.device_get(now.nearest)
    assert (np.diff(nearest.gap) >= 0).all()
    assert (np.diff(nearest.gap)[nearest.gap[:, 1:] < FAR] > 0).all()
    ring = arena(levels(), NEAREST, (1.0,))
    by_lane = jnp.array(nearest.code.reshape(WIDTH * NEAREST, -1))

    @jax.jit
    def gaps() -> jax.Array:
        def one(walk, code):
            walk = act(ring, walk, decode(code), DEFAULT_RULES)
            return walk, gap(ring.goals, walk.state)

        return jax.lax.scan(one, fresh_walk(ring.lanes), by_lane.T)[1]

    all_gaps, steps = np.asarray(gaps()).reshape(256, WIDTH, NEAREST), nearest.steps
    for level, kept in np.argwhere(nearest.gap < FAR):
        until = all_gaps[: steps[level, kept], level, kept]
        np.testing.assert_allclose(until[-1], nearest.gap[level, kept], rtol=1e-5)  # another program rounds differently
        assert until[-1] <= until.min() * (1 + 1e-5)
    assert (now.gap <= np.maximum(nearest.gap[:, 0] / NEARER, nearest.gap[:, 0])).all()


def test_result_depends_on_the_level_alone() -> None:
    """The search slot and the neighbours differ."""
    order = np.roll(np.arange(WIDTH), 1)
    now = begin(take(levels(), order), IDS[order], misses(), CONFIG)
    for _ in range(3):
        now = vary(now, CONFIG, DEFAULT_RULES)
    straight = begun()
    for _ in range(3):
        straight = vary(straight, CONFIG, DEFAULT_RULES)
    results = lambda now: jax.device_get((now.nearest, now.env_steps, now.gap, now.closed, now.code, now.length))
    jax.tree.map(lambda one, other: np.testing.assert_array_equal(one, other[order]), results(now), results(straight))


def test_interruption_changes_no_result() -> None:
    """The state moves to the host and back, as when other levels enter."""
    once = vary(begun(), CONFIG, DEFAULT_RULES)
    resumed = vary(jax.tree.map(jnp.array, jax.tree.map(np.array, once)), CONFIG, DEFAULT_RULES)
    twice = vary(vary(begun(), CONFIG, DEFAULT_RULES), CONFIG, DEFAULT_RULES)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(resumed), jax.device_get(twice))


def test_begin_has_the_types_of_vary() -> None:
    """Otherwise the first call would need a program of its own."""
    types = lambda now: jax.tree.leaves(jax.tree.map(jax.typeof, now))
    assert types(begun()) == types(vary(begun(), CONFIG, DEFAULT_RULES))


def test_env_steps_are_limited() -> None:
    """Env steps of all lanes count, in whole rounds, until a success or the limit."""
    end, call = ended(), ROUND * CONFIG.rounds
    assert (end.env_steps[BROKEN] >= CONFIG.variations).all()
    assert (end.env_steps[BROKEN] < CONFIG.variations + call).all()
    assert (end.env_steps[~BROKEN] < CONFIG.variations).all()
    assert (end.closed <= end.env_steps).all()
    impatient = replace(CONFIG, patience=16_384, patience_gap=0)
    now = replace(begun(), closed=jnp.full(WIDTH, 1024), env_steps=jnp.full(WIDTH, 1024 + 16_384))
    assert not under_way(now, impatient.ends).any()
    assert under_way(now, CONFIG.ends).all()
    assert not under_way(
        now, replace(CONFIG, patience=4 * 16_384, patience_gap=0).ends
    ).any()  # a quarter of what Go-Explore has
    assert under_way(now, replace(CONFIG, patience=4 * 16_384 + 4, patience_gap=0).ends).all()
    by_gap = replace(CONFIG, patience=4 * 16_384 + 4, patience_gap=0.2).ends
    now = replace(now, gap=jnp.where(jnp.array(BROKEN), 0.4, 0.2))
    np.testing.assert_array_equal(under_way(now, by_gap), ~BROKEN)  # half as much for twice the gap


def test_random_draws_are_never_reused() -> None:
    """Every round, level and search has its own draws."""
    some = [draw(draws, jnp.array(IDS[:2]), jnp.int32(steps), 3, 8) for draws in Draws for steps in (0, ROUND)]
    numbers = np.concatenate(some).reshape(-1, 8)
    assert len(np.unique(numbers)) > 0.99 * numbers.size


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
def test_change_applies_before_the_nearest_step(kind: int) -> None:
    """Earlier actions and dead entries stay; a resampled stretch is one action; shifted actions are unchanged."""
    rng = np.random.default_rng(kind)
    live = np.array([True, False, True, False, True, False])
    action = np.where(live[:, None], rng.integers(2, size=(ACTIONS, 256)), 0)
    code, steps = np.asarray(encode(jnp.array(action))), 60
    change = jax.jit(lambda steps, bits, live: edited(jnp.array(code), 255, change_of(steps, bits, live)))
    for _ in range(20):
        bits = rng.integers(2**32, size=5, dtype=np.uint32)
        bits[4] = (bits[4] & ~np.uint32(3)) | np.uint32(kind)
        after = np.asarray(change(jnp.int32(steps), jnp.array(bits), jnp.array(live)))
        first = int(bits[0] % steps)
        np.testing.assert_array_equal(after[:first], code[:first])
        assert (np.asarray(decode(jnp.array(after)))[~live] == 0).all()
        if kind < 2:
            new = np.unique(after[after != code])
            assert len(new) <= 2 ** int(live.sum())
        elif kind == 2:
            assert any((after[first : 256 - by] == code[first + by :]).all() for by in range(1, 9))
        else:
            assert any((after[first + by :] == code[first : 256 - by]).all() for by in range(1, 9))


def test_variation_has_at_least_one_change() -> None:
    """Their number follows from the bits of the first random number."""
    code, live = jnp.zeros(256, jnp.uint16), jnp.ones(ACTIONS, bool)
    bits = np.full((CHANGES, 5), 0, np.uint32)
    bits[:, 2], bits[:, 3] = 63, 5  # all entries, to another action
    bits[1:, 0] = 40  # the others begin later
    one, both = (jax.jit(changed)(code, 60, np.append(np.uint32(n), bits), live) for n in (0, 1))
    assert (np.asarray(one)[:60] == 5).all()
    assert (np.asarray(one)[60:] == 0).all()
    assert (np.asarray(both)[60:100] == 5).all()


def test_nearest_of_takes_the_trajectories_to_the_nearest_entries() -> None:
    """Unused entries and broken states are omitted; each repeats its last action, the start its first."""
    count = NEAREST
    steps, distance, nothing = np.zeros((1, count), int), np.full((1, count), FAR, np.float32), np.zeros((1, count))
    steps[0, :4], distance[0, :4] = [3, 5, 2, 0], [0.4, 0.1, np.nan, 0.2]
    code = np.arange(count * 6).reshape(1, count, 6).astype(np.uint16)
    entry: Any = nothing, nothing, code, steps, distance
    rest: Any = np.arange(count)[None] != 1, nothing, nothing, nothing[:, 0], nothing[:, 0]
    kept = nearest_of(Archive(ReachedStates(*entry), *rest))
    np.testing.assert_array_equal(kept.gap[0], np.array([0.2, 0.4, *[FAR] * (NEAREST - 2)], np.float32))
    np.testing.assert_array_equal(kept.steps[0, :2], [0, 3])
    np.testing.assert_array_equal(kept.code[0, :2], [[18] * 6, [0, 1, 2, 2, 2, 2]])


def test_first_of_keeps_the_nearest_trajectories() -> None:
    """Among trajectories with the same gap, the first stays; the others stay only if there is room."""
    gaps = np.array([[0.5, 0.25, 0.5, 0.25, 1.0] + [0.5] * (NEAREST - 1)], np.float32)
    count = gaps.shape[1]
    some = Approaches(np.zeros((1, count, 8), np.uint16), gaps, np.arange(count)[None])  # pyright: ignore
    kept = first_of(some)
    np.testing.assert_array_equal(kept.steps[0, :3], [1, 0, 4])
    assert kept.gap.shape == (1, NEAREST)
