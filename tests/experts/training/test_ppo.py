"""Advantages and the terms of the objective equal plain formulas, and PPO learns a bandit."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import ExpertConfig, Network
from levelproof.experts.networks.flat import resting_features
from levelproof.experts.objective import advantages, terms
from levelproof.experts.policy import forward, log_probability, network_of, sample
from levelproof.experts.training import ppo
from levelproof.experts.training.ppo import LevelConstants, Samples
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.observe.flat import dynamic_features

SIZE = SIZES["s"]
DYNAMIC = len(dynamic_features(SIZE))


def test_advantages_equal_the_plain_formula() -> None:
    rng = np.random.default_rng(0)
    value, reward = rng.normal(size=(2, 20, 3)).astype(np.float32)
    done, last = rng.random((20, 3)) < 0.2, rng.normal(size=3).astype(np.float32)
    expected, running, following = np.zeros_like(value), np.zeros(3), last
    for t in reversed(range(20)):
        alive = 1 - done[t]
        running = reward[t] + 0.9 * following * alive - value[t] + 0.9 * 0.8 * alive * running
        expected[t], following = running, value[t]
    np.testing.assert_allclose(advantages(value, reward, done, last, 0.9, 0.8), expected, rtol=1e-4, atol=1e-5)


def test_terms_equal_the_plain_formulas() -> None:
    """Some samples are on either side of the clipped ratio and of the clipped value, some within."""
    rng, count, clip = np.random.default_rng(2), 40, 0.2
    logits = rng.normal(size=(sum(CHOICES), count)).astype(np.float32)
    action = np.stack([rng.integers(0, choices, count) for choices in CHOICES])
    live = np.array([True, True, False, True, False, True])[:, None]
    gain, value, value_before, advantage = rng.normal(size=(4, count)).astype(np.float32)

    entries = np.split(logits, np.cumsum(CHOICES)[:-1])
    probability = [np.exp(entry) / np.exp(entry).sum(0) for entry in entries]
    of_action = np.array([entry[chosen, range(count)] for entry, chosen in zip(probability, action, strict=True)])
    nats = np.array([-(entry * np.log(entry)).sum(0) for entry in probability])
    log_now = (np.log(of_action) * live).sum(0)
    ratio = rng.uniform(0.5, 1.5, count).astype(np.float32)
    surrogate, error = np.zeros(count), np.zeros(count)
    for i in range(count):
        bound = min(max(ratio[i], 1 - clip), 1 + clip)
        surrogate[i] = min(ratio[i] * gain[i], bound * gain[i])
        target = value_before[i] + advantage[i]
        near = value_before[i] + min(max(value[i] - value_before[i], -clip), clip)
        error[i] = max((value[i] - target) ** 2, (near - target) ** 2) / 2
    for sign in (-1, 1):
        assert (surrogate != ratio * gain)[np.sign(gain) == sign].any()
        assert (surrogate == ratio * gain)[np.sign(gain) == sign].any()
    worse = error > (value - value_before - advantage) ** 2 / 2 + 1e-3
    assert 0 < worse.sum() < count

    got = jax.jit(terms)(logits, value, action, live, log_now - np.log(ratio), value_before, advantage, gain, clip)
    np.testing.assert_allclose(got.surrogate, surrogate.mean(), rtol=1e-4)
    np.testing.assert_allclose(got.value_error, error.mean(), rtol=1e-4)
    np.testing.assert_allclose(got.entropy, (nats * live).sum(0).mean(), rtol=1e-4)
    np.testing.assert_allclose(got.log_probability, log_now, rtol=1e-4)


def test_loss_rewards_entropy_and_the_rehearsed_actions() -> None:
    """At uniform logits: it falls by a bonus times their entropy, and rises where rehearsed actions are unlikely."""
    config = ExpertConfig(network=Network.FLAT, width=16, entropy_weight=0.0, imitation_weight=0.0)
    network, count = network_of(SIZE, config), 8
    constants = LevelConstants(jnp.zeros(len(resting_features(SIZE))), jnp.ones(len(CHOICES), bool))
    begun = jax.eval_shape(lambda: ppo.init(jax.random.key(0), network, constants.features, config))
    params = jax.tree.map(lambda x: jnp.zeros(x.shape), begun.params)
    nats, zeros = np.log(CHOICES).sum(), jnp.zeros(count)
    rehearsed = jnp.arange(count) < 2
    minibatch = Samples(
        jnp.ones((DYNAMIC, count)), jnp.zeros((len(CHOICES), count)), zeros - nats, zeros, zeros, rehearsed * 1.0
    )

    @jax.jit
    def losses():
        some = config, replace(config, entropy_weight=0.5), replace(config, imitation_weight=0.5)
        return [ppo.loss(params, network, constants, minibatch, each) for each in some]

    plain, with_bonus, imitating = losses()
    np.testing.assert_allclose(plain, 0.0, atol=1e-6)
    np.testing.assert_allclose(with_bonus, -0.5 * nats, rtol=1e-4)
    np.testing.assert_allclose(imitating, 0.5 * nats * 2 / count, rtol=1e-4)


def test_loss_weighs_the_error_of_values() -> None:
    """Values of 0, in place of 1, have an error of a half; equal advantages are no gain."""
    config = ExpertConfig(network=Network.FLAT, width=16, entropy_weight=0.0, imitation_weight=0.0, value_weight=0.5)
    network, count = network_of(SIZE, config), 8
    constants = LevelConstants(jnp.zeros(len(resting_features(SIZE))), jnp.ones(len(CHOICES), bool))
    begun = jax.eval_shape(lambda: ppo.init(jax.random.key(0), network, constants.features, config))
    params = jax.tree.map(lambda x: jnp.zeros(x.shape), begun.params)
    zeros = jnp.zeros(count)
    even = zeros - np.log(CHOICES).sum()
    minibatch = Samples(jnp.ones((DYNAMIC, count)), jnp.zeros((len(CHOICES), count)), even, zeros, zeros + 1, zeros)
    weighed = jax.jit(lambda: ppo.loss(params, network, constants, minibatch, config))()
    np.testing.assert_allclose(weighed, 0.5 * 0.5, rtol=1e-4)


def test_rows_round_trip_samples() -> None:
    rng, time, lanes = np.random.default_rng(1), 4, 3
    moving = rng.normal(size=(time, DYNAMIC, lanes)).astype(np.float32)
    action = rng.integers(0, 2, (time, len(CHOICES), lanes))
    log_probs, value, advantage, rehearsed = rng.normal(size=(4, time, lanes)).astype(np.float32)
    back = ppo.from_rows(ppo.as_rows(Samples(moving, action, log_probs, value, advantage, rehearsed)))
    np.testing.assert_array_equal(back.moving, np.moveaxis(moving, 1, 0).reshape(DYNAMIC, -1))
    np.testing.assert_array_equal(back.action, np.moveaxis(action, 1, 0).reshape(len(CHOICES), -1))
    for mine, theirs in zip(back[2:], (log_probs, value, advantage, rehearsed), strict=True):
        np.testing.assert_array_equal(mine, theirs.reshape(-1))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("kind", [Network.FLAT, pytest.param(Network.ENTITY, marks=pytest.mark.campaign)])
def test_update_learns_a_bandit(kind: Network, seed: int) -> None:
    """One action entry pays if it is 2; after a few updates it is chosen nearly always."""
    config = ExpertConfig(network=kind, width=16, encoding=16, environments=32, horizon=8, learning_rate=3e-3)
    network, count = network_of(SIZE, config), config.steps_per_update
    features = jax.jit(network.constant)(sample_levels(np.array([seed]), SIZE))
    constant = jax.tree.map(lambda x: np.asarray(x)[..., 0], features)
    train_state = jax.jit(lambda key: ppo.init(key, network, constant, config))(jax.random.key(seed))
    constants, moving = LevelConstants(constant, jnp.ones(len(CHOICES), bool)), jnp.ones((DYNAMIC, count))

    @jax.jit
    def learn(now, key):
        logits, value = forward(network, now.params, constants.features, moving)
        action = sample(logits, jax.random.uniform(key, (len(CHOICES), count)))
        reward = (action[1] == 2).astype(jnp.float32)
        log_probs = log_probability(logits, action, constants.live[:, None])
        columns = moving, action, log_probs, value, reward - value, jnp.zeros(count)
        samples = Samples(*(x[None] for x in columns))
        rows = ppo.as_rows(samples)
        return ppo.update(now, jax.random.fold_in(key, 1), network, constants, rows, config), reward.mean()

    rewards = []
    for key in jax.random.split(jax.random.key(seed), 40):
        train_state, reward = learn(train_state, key)
        rewards.append(float(reward))
    assert rewards[0] < 0.5
    assert rewards[-1] > 0.95


@pytest.mark.parametrize(("environments", "horizon"), [(32, 16), (7, 5), (1, 9), (6, 1)])
def test_shuffled_gives_each_run_one_sample_per_environment(environments: int, horizon: int) -> None:
    config = ExpertConfig(
        environments=environments,
        horizon=horizon,
        minibatches=1,
        rehearsals=0,
        attempts=1,
        sticky_attempts=0,
        perturbed_attempts=0,
    )
    shuffle = jax.jit(lambda seed: ppo.shuffled(jax.random.key(seed), config))
    orders = [np.asarray(shuffle(seed)) for seed in range(20)]
    for order in orders:
        assert sorted(order) == list(range(environments * horizon))
        for run in order.reshape(horizon, environments):
            assert sorted(run % environments) == list(range(environments))
    if environments * horizon > 10:
        assert len({tuple(order) for order in orders}) == len(orders)


def test_shuffled_can_put_every_sample_first() -> None:
    config = ExpertConfig(
        environments=4, horizon=4, minibatches=1, rehearsals=0, attempts=1, sticky_attempts=0, perturbed_attempts=0
    )
    many = jax.jit(jax.vmap(lambda key: ppo.shuffled(key, config)))
    orders = many(jax.random.split(jax.random.key(0), 4000))
    counts = np.bincount(np.asarray(orders)[:, 0], minlength=16)
    assert counts.min() > 250 - 5 * 16
    assert counts.max() < 250 + 5 * 16
