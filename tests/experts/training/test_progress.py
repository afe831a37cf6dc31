"""Running totals equal a loop over episodes."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.experts.training import progress

STEPS, ENVIRONMENTS = 6, 3
follow = jax.jit(progress.follow)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_follow_adds_up_totals(seed: int, p_done: float, p_goal: float) -> None:
    rng, rollouts = np.random.default_rng(seed), 3
    shape = (rollouts, STEPS, ENVIRONMENTS)
    reward = rng.integers(-2, 3, shape).astype(np.float32)
    done = rng.random(shape) < p_done
    goal = done & (rng.random(shape) < p_goal)
    own = np.array([True, True, rng.random() < 0.5])

    totals, shares = progress.start(ENVIRONMENTS), []
    for r in range(rollouts):
        totals, share = follow(totals, reward[r], done[r], goal[r], own)
        shares.append(share)

    long = lambda x: x.reshape(-1, ENVIRONMENTS)
    returns = []
    for e in range(ENVIRONMENTS):
        running = 0.0
        for r, d in zip(long(reward)[:, e], long(done)[:, e], strict=True):
            running += r
            if d:
                returns.append(running)
                running = 0.0
    hits = np.flatnonzero((long(goal) & own).any(-1))  # goals reached in other lanes are not the expert's own
    assert totals.episodes == len(returns)
    assert totals.best_return == max(returns, default=-np.inf)
    assert totals.first_success == ((hits[0] + 1) * ENVIRONMENTS if len(hits) else progress.NEVER)
    ended, reached = (done & own).sum((1, 2)), (goal & own).sum((1, 2))
    np.testing.assert_allclose(shares, np.where(ended > 0, reached / np.maximum(ended, 1), np.nan), rtol=1e-6)
    assert totals.env_steps == rollouts * STEPS * ENVIRONMENTS


def test_watch_records_when_parameters_stop_being_finite() -> None:
    totals = progress.start(ENVIRONMENTS)
    for steps, last, expected in ((10, 1.0, progress.NEVER), (20, np.inf, 20), (30, np.nan, 20), (40, 1.0, 20)):
        params = {"kernel": np.ones((2, 2)), "bias": np.array([0.0, last])}
        totals = progress.watch(totals._replace(env_steps=np.int32(steps)), params)
        assert totals.diverged == expected
