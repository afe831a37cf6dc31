"""Random play follows the task's own rules."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.search.play import Arena, Walk, arena, decode, encode, fresh_walk, play
from levelproof.experts.search.rows import from_rows, to_rows
from levelproof.levelgen.level import concatenate_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.search.worlds import broken, switchback, valley

LANES, STEPS = 16, 256
CHANCES = (0.02, 0.3)
RULES = replace(DEFAULT_RULES, max_timesteps=200)


def ring_of_all() -> Arena:
    return jax.jit(arena, static_argnums=(1, 2))(concatenate_levels([switchback(), valley(), broken()]), LANES, CHANCES)


def random_bits(seed: int) -> jax.Array:
    return jax.random.bits(jax.random.key(seed), (STEPS, 6, 3 * LANES))


@jax.jit
def played(ring: Arena, bits: jax.Array) -> tuple[Walk, jax.Array]:
    """Play all lanes from their starts; return walk and actions."""
    walk, code = play(ring, fresh_walk(ring.lanes), bits, RULES)
    return walk, decode(code)


def test_decode_inverts_encode() -> None:
    code = jnp.arange(np.prod(CHOICES), dtype=jnp.uint16)
    np.testing.assert_array_equal(encode(decode(code)), code)
    assert (np.asarray(decode(code)) < np.array(CHOICES)[:, None]).all()


def test_rows_round_trip_states_exactly() -> None:
    levels = concatenate_levels([switchback(), valley(), valley()])
    state = jax.device_get(jax.jit(task.reset)(levels).state)
    noisy = jax.tree.map(lambda x: x + np.arange(3, dtype=x.dtype) if x.dtype == np.float32 else ~x, state)
    back = jax.jit(lambda state: from_rows(to_rows(state), state))(noisy)
    jax.tree.map(np.testing.assert_array_equal, back, noisy)


@pytest.mark.slow
def test_play_ends_episodes_as_the_task_does() -> None:
    """Goal, failure, time limit and broken worlds come at the same env step, after the same states."""
    ring, bits = ring_of_all(), random_bits(3)
    walk, actions = played(ring, bits)

    @jax.jit
    def judged(lanes, actions):
        def step(now, action):
            after, result = task.advance(lanes, now, action, RULES)
            return after, (result.done, result.goal)

        return jax.lax.scan(step, task.reset(lanes), jnp.moveaxis(actions, 0, 1))

    last, (done, goal) = judged(ring.lanes, actions)
    first, lane = np.argmax(done, axis=0), np.arange(3 * LANES)
    assert np.asarray(done).any(0).all()
    assert np.asarray(walk.ended).all()
    expected = np.where(np.asarray(goal)[first, lane], first + 1, 0)
    np.testing.assert_array_equal(walk.reached, expected)
    jax.tree.map(np.testing.assert_array_equal, walk.state, last.state)
    short, _ = played(ring, bits[:100])
    np.testing.assert_array_equal(short.ended, np.asarray(done)[:100].any(0))


def test_persistent_resamples_with_its_probabilities() -> None:
    """Entries are kept at their rate, and every choice occurs."""
    ring = ring_of_all()
    ring = ring._replace(live=np.ones_like(ring.live))
    parts = [played(ring, random_bits(i))[1] for i in range(4)]
    actions = np.concatenate(jax.device_get(parts), -1)
    for entry, choices in enumerate(CHOICES):
        assert set(np.unique(actions[entry])) == set(range(choices))
        moves = (actions[entry, 1:] != actions[entry, :-1]).mean(0).reshape(-1, 2, LANES // 2).mean((0, 2))
        np.testing.assert_allclose(moves, np.array(CHANCES) * (1 - 1 / choices), rtol=0.25)


def test_play_keeps_dead_entries_zero() -> None:
    ring = ring_of_all()
    _, actions = played(ring, random_bits(0))
    np.testing.assert_array_equal(np.asarray(actions).any((1, 2)), np.asarray(ring.live).any(1))
