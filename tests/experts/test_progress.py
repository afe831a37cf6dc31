"""Running totals against a loop over episodes."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from experts import progress

STEPS, LEVELS, ENVIRONMENTS = 6, 2, 3
follow = jax.jit(progress.follow)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_totals(seed: int, p_done: float, p_goal: float) -> None:
    rng, rollouts = np.random.default_rng(seed), 3
    shape = (rollouts, STEPS, LEVELS, ENVIRONMENTS)
    reward = rng.integers(-2, 3, shape).astype(np.float32)
    done = rng.random(shape) < p_done
    goal = done & (rng.random(shape) < p_goal)

    totals, shares = progress.start(LEVELS, ENVIRONMENTS), []
    for r in range(rollouts):
        totals, share = follow(totals, reward[r], done[r], goal[r])
        shares.append(share)

    long = lambda x: x.reshape(-1, LEVELS, ENVIRONMENTS)
    for level in range(LEVELS):
        returns = []
        for e in range(ENVIRONMENTS):
            running = 0.0
            for r, d in zip(long(reward)[:, level, e], long(done)[:, level, e], strict=True):
                running += r
                if d:
                    returns.append(running)
                    running = 0.0
        hits = np.flatnonzero(long(goal)[:, level].any(-1))
        first = (hits[0] + 1) * ENVIRONMENTS if len(hits) else progress.NEVER
        assert totals.episodes[level] == len(returns)
        assert totals.best_return[level] == max(returns, default=-np.inf)
        assert totals.first_success[level] == first
        ended, reached = done[:, :, level].sum((1, 2)), goal[:, :, level].sum((1, 2))
        expected = np.where(ended > 0, reached / np.maximum(ended, 1), np.nan)
        np.testing.assert_allclose([s[level] for s in shares], expected, rtol=1e-6)
    assert totals.env_steps == rollouts * STEPS * ENVIRONMENTS
