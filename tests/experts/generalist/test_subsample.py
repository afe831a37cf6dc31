"""The choice of samples that an update learns from."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from levelproof.experts.generalist.config import CHUNK, PPOConfig
from levelproof.experts.generalist.subsample import EVEN, LEAST, choose

TIMES, LANES = 8, 64


def drawn(seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return gains with many near 0, which samples count, and what each would contribute."""
    of_gain, of_counts, of_x = jax.random.split(jax.random.key(seed), 3)
    gain = jax.random.normal(of_gain, (TIMES, LANES)) ** 3
    counts = jax.random.uniform(of_counts, (TIMES, LANES)) < 0.9
    return gain, counts, jax.random.normal(of_x, (TIMES, LANES))


@given(seed=st.integers(0, 2**31 - 1), samples=st.sampled_from((1, 7, LANES // 2, LANES)))
def test_only_what_counts_is_chosen_about_as_often_as_its_gain_asks_for(seed: int, samples: int) -> None:
    gain, counts, _ = drawn(seed)
    lane, weight = choose(gain, counts, samples, jax.random.key(seed))
    assert lane.shape == weight.shape == (TIMES, samples)
    size = np.where(counts, np.abs(gain), 0)
    chance = np.where(counts, size + EVEN * size.mean() + LEAST, 0)
    expected = samples * chance / chance.sum(1, keepdims=True)
    times = np.stack([np.bincount(each, minlength=LANES) for each in np.asarray(lane)])
    assert (np.abs(times - expected) < 1 + 1e-3).all()
    assert not times[~counts].any()
    chosen = np.take_along_axis(chance, np.asarray(lane), 1)
    np.testing.assert_allclose(
        weight * chosen * LANES, np.broadcast_to(chance.sum(1)[:, None], chosen.shape), rtol=1e-4
    )


def test_weighted_means_have_the_expectation_of_all_samples() -> None:
    gain, counts, x = drawn(0)
    keys = jax.random.split(jax.random.key(1), 4096)
    lane, weight = jax.vmap(lambda key: choose(gain, counts, LANES // 4, key))(keys)
    taken = jax.vmap(lambda lane: jnp.take_along_axis(x, lane, 1))(lane)
    means = (weight * taken).mean(2)  # [key, time]
    error = means.std(0) / np.sqrt(len(keys))
    np.testing.assert_array_less(jnp.abs(means.mean(0) - jnp.where(counts, x, 0).mean(1)), 5 * error)


def test_weights_are_0_if_no_sample_counts() -> None:
    gain, counts, _ = drawn(2)
    _, weight = choose(gain, counts.at[3].set(False), LANES, jax.random.key(0))
    assert not weight[3].any()
    assert jnp.isfinite(weight).all()


def test_equal_gains_are_chosen_evenly() -> None:
    lane, weight = choose(jnp.ones((1, LANES)), jnp.ones((1, LANES), bool), LANES // 2, jax.random.key(0))
    assert (np.diff(lane[0]) == 2).all()
    np.testing.assert_allclose(weight, 1, rtol=1e-5)
    _, weight = choose(jnp.zeros((1, LANES)), jnp.ones((1, LANES), bool), LANES // 2, jax.random.key(0))
    np.testing.assert_allclose(weight, 1, rtol=1e-5)


def test_a_draw_that_rounds_up_to_the_total_chooses_what_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape: jnp.full(shape, 1 - 2**-23))
    counts = jnp.ones((1, 2048), bool).at[0, -1].set(False)
    lane, weight = choose(jnp.ones((1, 2048)), counts, 1024, jax.random.key(0))
    assert lane.max() == 2046
    assert weight.max() < 1.01


@pytest.mark.parametrize(
    ("lanes", "share", "samples"),
    [(2048, 0.5, 1024), (2048, 0.3, 2 * CHUNK), (2048, 0.01, 20), (64, 1, 64), (25600, 0.29, 29 * CHUNK)],
)
def test_samples_are_whole_chunks(lanes: int, share: float, samples: int) -> None:
    assert PPOConfig(environments=lanes, subsample=share).samples(1) == samples
