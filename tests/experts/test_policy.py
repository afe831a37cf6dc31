"""The networks against plain formulas."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experts import policy
from experts.policy import ActorCritic
from levelgen.actions import CHOICES
from levelgen.level import SIZES
from levelgen.observe import dynamic_features, feature_count

SIZE = SIZES["s"]
ALL = jnp.ones((len(CHOICES), 1), bool)


@pytest.fixture(scope="module")
def network() -> tuple[ActorCritic, dict]:
    network = ActorCritic(SIZE, width=8, depth=2)
    params = network.init(
        jax.random.key(0), jnp.zeros(feature_count(SIZE)), jnp.zeros((len(dynamic_features(SIZE)), 1))
    )
    return network, jax.tree.map(lambda x: x + 0.1, params)  # biases count too


def test_folding_constant_features_is_the_network_of_the_whole_observation(network) -> None:
    net, params = network
    rng, lanes = np.random.default_rng(0), 5
    whole = rng.normal(size=(feature_count(SIZE), lanes)).astype(np.float32)
    still = np.setdiff1d(np.arange(len(whole)), dynamic_features(SIZE))
    whole[still] = whole[still, :1]
    constant = whole[:, 0].copy()
    constant[dynamic_features(SIZE)] = 0

    logits, value = policy.forward(net, params, constant, whole[dynamic_features(SIZE)])

    def plain(name):
        x = whole
        for layer in ("FirstDense_0", "Dense_0"):
            p = params["params"][name][layer]
            x = np.tanh(p["kernel"] @ x + p["bias"][:, None])
        p = params["params"][name]["Dense_1"]
        return p["kernel"] @ x + p["bias"][:, None]

    np.testing.assert_allclose(logits, plain("policy"), atol=1e-5)
    np.testing.assert_allclose(value, plain("value")[0], atol=1e-5)


def test_gradient_reaches_kernels_of_constant_features(network) -> None:
    net, params = network
    constant = jnp.full(feature_count(SIZE), 0.01).at[dynamic_features(SIZE)].set(0)
    loss = lambda p: policy.forward(net, p, constant, jnp.full((len(dynamic_features(SIZE)), 3), 0.01))[1].sum()
    kernel = jax.grad(loss)(params)["params"]["value"]["FirstDense_0"]["kernel"]
    assert (np.abs(kernel) > 0).all()


def test_probabilities_of_all_actions_sum_to_one() -> None:
    logits = jax.random.normal(jax.random.key(1), (sum(CHOICES), 1)) * 3
    actions = np.array(list(itertools.product(*map(range, CHOICES)))).T
    many = jnp.repeat(logits, actions.shape[1], axis=1)
    chances = policy.log_probability(many, jnp.asarray(actions), ALL)
    assert float(jnp.exp(chances).sum()) == pytest.approx(1, abs=1e-5)
    assert float(policy.entropy(logits, ALL)[0]) == pytest.approx(float(-(jnp.exp(chances) * chances).sum()), abs=1e-4)


def test_entries_that_nothing_obeys_do_not_count() -> None:
    logits = jax.random.normal(jax.random.key(4), (sum(CHOICES), 2))
    live = jnp.array([False, True, False, False, False, True])[:, None]
    alone = jax.nn.log_softmax(logits[3:6], axis=0)[2] + jax.nn.log_softmax(logits[14:16], axis=0)[1]
    for others in (0, 1):
        action = jnp.full((6, 2), others).at[1].set(2).at[5].set(1)
        np.testing.assert_allclose(policy.log_probability(logits, action, live), alone, rtol=1e-6)
    dead = jnp.zeros((6, 1), bool)
    np.testing.assert_array_equal(policy.entropy(logits, dead), 0)


def test_samples_follow_the_probabilities() -> None:
    logits = jax.random.normal(jax.random.key(2), (sum(CHOICES), 1))
    lanes = 40_000
    uniform = jax.random.uniform(jax.random.key(3), (len(CHOICES), lanes))
    actions = np.asarray(policy.sample(jnp.repeat(logits, lanes, axis=1), uniform))
    for entry, (first, count) in enumerate(zip(policy.FIRSTS, CHOICES, strict=True)):
        expected = np.asarray(jax.nn.softmax(logits[first : first + count, 0]))
        shares = np.bincount(actions[entry], minlength=count) / lanes
        assert len(shares) == count
        np.testing.assert_allclose(shares, expected, atol=5 * np.sqrt(0.25 / lanes))


def test_most_probable() -> None:
    logits = jnp.concatenate([jnp.eye(n)[n - 1] for n in CHOICES])[:, None]
    np.testing.assert_array_equal(policy.most_probable(logits)[:, 0], np.array(CHOICES) - 1)


@pytest.mark.parametrize("shape", [(64, 140), (16, 64), (64, 21), (1, 64)])
def test_initial_kernels_are_orthogonal(shape: tuple[int, int]) -> None:
    kernels = jax.vmap(lambda key: policy.orthogonal(2.0)(key, shape))(jax.random.split(jax.random.key(0), 3))
    for kernel in np.asarray(kernels):
        short = kernel if shape[0] <= shape[1] else kernel.T
        np.testing.assert_allclose(short @ short.T, 4 * np.eye(len(short)), atol=2e-5)
    assert np.abs(kernels[0] - kernels[1]).max() > 0.1
