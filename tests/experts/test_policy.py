"""Distributions from a network's logits."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts import policy
from levelproof.levelgen.task.actions import CHOICES

ALL = np.ones((len(CHOICES), 1), bool)
log_probability, entropy, draw = map(jax.jit, (policy.log_probability, policy.entropy, policy.sample))


def test_probabilities_of_all_actions_sum_to_one() -> None:
    logits = jax.random.normal(jax.random.key(1), (sum(CHOICES), 1)) * 3
    actions = np.array(list(itertools.product(*map(range, CHOICES)))).T
    many = np.repeat(logits, actions.shape[1], axis=1)
    chances = np.asarray(log_probability(many, actions, ALL))
    assert float(np.exp(chances).sum()) == pytest.approx(1, abs=1e-5)
    assert float(entropy(logits, ALL)[0]) == pytest.approx(float(-(np.exp(chances) * chances).sum()), abs=1e-4)


def test_log_probability_ignores_dead_entries() -> None:
    logits = jax.random.normal(jax.random.key(4), (sum(CHOICES), 2))
    live = np.array([False, True, False, False, False, True])[:, None]
    alone = jax.nn.log_softmax(logits[3:6], axis=0)[2] + jax.nn.log_softmax(logits[14:16], axis=0)[1]
    for others in (0, 1):
        action = np.full((6, 2), others)
        action[1], action[5] = 2, 1
        np.testing.assert_allclose(log_probability(logits, action, live), alone, rtol=1e-6)
    dead = np.zeros((6, 1), bool)
    np.testing.assert_array_equal(entropy(logits, dead), 0)


def test_sample_follows_the_probabilities() -> None:
    logits = jax.random.normal(jax.random.key(2), (sum(CHOICES), 1))
    lanes = 40_000
    uniform = jax.random.uniform(jax.random.key(3), (len(CHOICES), lanes))
    actions = np.asarray(draw(np.repeat(logits, lanes, axis=1), uniform))
    for entry, (first, count) in enumerate(zip(policy.FIRSTS, CHOICES, strict=True)):
        expected = np.asarray(jax.nn.softmax(logits[first : first + count, 0]))
        shares = np.bincount(actions[entry], minlength=count) / lanes
        assert len(shares) == count
        np.testing.assert_allclose(shares, expected, atol=5 * np.sqrt(0.25 / lanes))


def test_most_probable_takes_the_first_of_ties() -> None:
    logits = jnp.concatenate([jnp.eye(n)[n - 1] for n in CHOICES])[:, None]
    np.testing.assert_array_equal(policy.most_probable(logits)[:, 0], np.array(CHOICES) - 1)
