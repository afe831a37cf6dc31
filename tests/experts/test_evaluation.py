"""First episodes equal a plain loop, do not depend on batches, and follow their player's rule."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts import evaluation
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.evaluation import (
    STAY,
    Moment,
    do_nothing,
    play,
    play_most_probable,
    play_randomly,
    play_sampled,
    play_sticky,
)
from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy, policy_logits
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.rules import DEFAULT_RULES

IDS, ATTEMPTS = np.arange(700, 724), 3
FEW = 2  # lanes; with more attempts than lanes, one program serves any number of attempts


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.device_get(sample_levels(IDS, "s"))


@pytest.fixture(scope="module")
def played(levels: Level) -> evaluation.FirstEpisodes:
    return play(play_randomly, (), levels, IDS, ATTEMPTS, 1, DEFAULT_RULES)


@jax.jit
def drawn(level_id: jax.Array, attempt: jax.Array) -> jax.Array:
    """Return the random numbers of an attempt with seed 1, time axis first."""
    key = evaluation._keys(level_id[None], jnp.uint32(1), jnp.arange(ATTEMPTS))[attempt]
    draw = lambda step: jax.random.uniform(jax.random.fold_in(key, step), (6,))
    return jax.lax.map(draw, jnp.arange(RECORD_STEPS))


@pytest.mark.slow
def test_attempts_equal_a_plain_loop(levels: Level, played: evaluation.FirstEpisodes) -> None:
    """One lane, one step at a time, the actions drawn from the same keys."""
    step = jax.jit(partial(task.advance, params=DEFAULT_RULES))
    for number, attempt in ((0, 0), (5, 2), (11, 1)):
        level = take(levels, np.array([number]))
        uniform = np.asarray(drawn(IDS[number], attempt))
        now, steps, goal = task.reset(level), 0, False
        while steps < RECORD_STEPS:
            action = np.floor(uniform[steps] * CHOICES).astype(np.int32)[:, None]
            now, result = step(level, now, np.where(action_mask(level), action, 0))
            steps += 1
            if result.done[0]:
                goal = bool(result.goal[0])
                break
        assert (goal, steps) == (played.solved[number, attempt], played.env_steps[number, attempt])


@pytest.mark.slow
def test_batches_change_no_result(levels: Level, played: evaluation.FirstEpisodes) -> None:
    order = np.random.default_rng(0).permutation(len(IDS))
    other = play(play_randomly, (), take(levels, order), IDS[order], ATTEMPTS, 1, DEFAULT_RULES, lanes=FEW)
    np.testing.assert_array_equal(other.solved, played.solved[order])
    np.testing.assert_array_equal(other.env_steps, played.env_steps[order])


def test_batches_hold_at_most_their_lanes(
    levels: Level, played: evaluation.FirstEpisodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More attempts than lanes are played in rounds, with the same results."""
    programs = []
    program_of = evaluation._program
    monkeypatch.setattr(evaluation, "_program", lambda *given: programs.append(given[1]) or program_of(*given))
    two = play(play_randomly, (), levels, IDS, ATTEMPTS, 1, DEFAULT_RULES, lanes=FEW)
    assert programs == [FEW]
    np.testing.assert_array_equal(two.solved, played.solved)
    np.testing.assert_array_equal(two.env_steps, played.env_steps)


def test_more_attempts_keep_the_first_ones(levels: Level, played: evaluation.FirstEpisodes) -> None:
    more = play(play_randomly, (), levels, IDS, ATTEMPTS + 2, 1, DEFAULT_RULES, lanes=FEW)
    np.testing.assert_array_equal(more.solved[:, :ATTEMPTS], played.solved)
    other = play(play_randomly, (), levels, IDS, ATTEMPTS, 2, DEFAULT_RULES)
    assert (other.env_steps != played.env_steps).any()


def test_stored_actions_solve_their_level(levels: Level, played: evaluation.FirstEpisodes) -> None:
    """A player that repeats the actions of random play's first attempts solves the same levels, in as many steps."""
    uniform = np.stack([drawn(level_id, 0) for level_id in IDS], -1)
    actions = np.floor(uniform * np.array(CHOICES)[:, None]).astype(np.int32)
    record = lambda params, moment: params[moment.now.timestep[0]]
    played_back = lambda actions: play(record, actions, levels, IDS, 1, 0, DEFAULT_RULES, lanes=len(IDS))
    again, still = played_back(actions), played_back(np.zeros_like(actions))
    np.testing.assert_array_equal(again.solved[:, 0], played.solved[:, 0])
    np.testing.assert_array_equal(again.env_steps[:, 0], played.env_steps[:, 0])
    assert (again.solved & ~still.solved).any()  # the actions matter


def test_first_attempts_are_those_of_all_attempts(levels: Level, played: evaluation.FirstEpisodes) -> None:
    first = evaluation.first_attempts(play_randomly, (), levels, IDS, 1, DEFAULT_RULES)
    np.testing.assert_array_equal(first.solved, played.solved[:, 0])
    np.testing.assert_array_equal(first.env_steps, played.env_steps[:, 0])
    record = replay(levels, first.action)
    ends = np.argmax(record.done, 0)
    np.testing.assert_array_equal(record.goal[ends, np.arange(len(IDS))], played.solved[:, 0])
    np.testing.assert_array_equal(ends[record.done.any(0)] + 1, played.env_steps[record.done.any(0), 0])


def test_players_draw_as_they_say(levels: Level) -> None:
    lanes = 24
    rng = np.random.default_rng(0)
    before = np.ones((6, lanes), np.int32)
    start = task.reset(levels)
    moment = Moment(levels, start, before, rng.random((6, lanes), np.float32))
    even = np.asarray(play_randomly((), moment))
    assert (even >= 0).all()
    assert (even < np.array(CHOICES)[:, None]).all()
    np.testing.assert_array_equal(play_sticky((), moment), even)  # nothing to repeat at the start
    going = moment._replace(now=task.TaskState(start.state, start.timestep + 1, start.last_distance))
    kept = np.asarray(moment.uniform) < STAY
    sticky = np.asarray(play_sticky((), going))
    assert (sticky[kept] == 1).all()
    drawn_again = np.asarray(evaluation.evenly((moment.uniform - STAY) / (1 - STAY)))
    np.testing.assert_array_equal(sticky[~kept], drawn_again[~kept])
    assert set(drawn_again[:4][~kept[:4]]) == {0, 1, 2}
    assert not np.asarray(do_nothing((), moment)).any()


@pytest.mark.slow
def test_policy_plays_by_its_logits(levels: Level) -> None:
    """Against numpy's softmax of each entry's logits, drawn by inversion."""
    network, lanes = NetworkConfig(PolicyKind.ATTENTION, width=8, depth=1, heads=2), len(IDS)
    params, uniform = initial_policy(jax.random.key(0), network, SIZES["s"]), np.random.default_rng(0)
    params = jax.tree.map(lambda x: 3 * x, params)  # initial policies are almost even
    moment = Moment(levels, task.reset(levels), np.zeros((6, lanes), np.int32), uniform.random((6, lanes), np.float32))
    logits = np.asarray(jax.jit(policy_logits, static_argnums=1)(params, network, levels, levels.state))
    entries = np.split(logits, np.cumsum(CHOICES)[:-1])
    live = np.asarray(action_mask(levels))
    assert all(np.ptp(entry, axis=0)[mine].min() > 0 for entry, mine in zip(entries, live, strict=True)), "no ties"
    greedy = np.asarray(jax.jit(play_most_probable(network))(params, moment))
    np.testing.assert_array_equal(greedy[live], np.stack([entry.argmax(0) for entry in entries])[live])
    sampled, away = np.asarray(jax.jit(play_sampled(network))(params, moment)), 1e-5
    for number, entry in enumerate(entries):
        chances = np.exp(entry - entry.max(0))
        ends = np.cumsum(chances / chances.sum(0), 0)
        drawn, clear = (ends <= moment.uniform[number]).sum(0), np.abs(ends - moment.uniform[number]).min(0) > away
        mine = live[number] & clear
        np.testing.assert_array_equal(sampled[number, mine], drawn[mine])
    assert (sampled[live] != greedy[live]).any()
