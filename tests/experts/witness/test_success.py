"""Successes of training equal a loop over the rollout."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.success import find, no_success, remember

HORIZON, ENVIRONMENTS, ROLLOUTS = 32, 3, 10


@jax.jit
def look(recent, action, goal, timestep, known):
    history = np.concatenate if isinstance(recent, np.ndarray) else jax.numpy.concatenate
    history = history([recent, action])
    return history[HORIZON:], remember(known, find(history, goal, timestep))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.001, 0.01, 0.1]))
def test_find_returns_the_first_success_with_its_actions(seed: int, p_end: float) -> None:
    rng = np.random.default_rng(seed)
    steps = HORIZON * ROLLOUTS
    action = rng.integers(0, 3, (steps, 6, ENVIRONMENTS)).astype(np.int8)
    done = rng.random((steps, ENVIRONMENTS)) < p_end
    timestep = np.zeros((steps, ENVIRONMENTS), np.int32)
    for e in range(ENVIRONMENTS):
        for t in range(1, steps):
            timestep[t, e] = 0 if done[t - 1, e] else timestep[t - 1, e] + 1
            done[t, e] |= timestep[t, e] == RECORD_STEPS - 1
    goal = done & (rng.random(done.shape) < 0.5)

    recent, known = np.zeros((RECORD_STEPS, 6, ENVIRONMENTS), np.int8), jax.tree.map(lambda x: x[0], no_success(1))
    for r in range(ROLLOUTS):
        part = slice(r * HORIZON, (r + 1) * HORIZON)
        recent, known = look(recent, action[part], goal[part], timestep[part], known)
    known = jax.device_get(known)

    hits = np.argwhere(goal)
    if not len(hits):
        assert known.length == 0
        return
    t, e = hits[0]
    start = t - timestep[t, e]
    assert known.length == t + 1 - start
    np.testing.assert_array_equal(known.action[: known.length], action[start : t + 1, :, e])
    assert not np.any(known.action[known.length :])
