"""The flat network against the plain formula on the whole observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experts.networks.flat import FlatNetwork
from experts.policy import Params, forward, initial
from levelgen.level import SIZES
from levelgen.observe import dynamic_features, feature_count

SIZE = SIZES["s"]


@pytest.fixture(scope="module")
def network() -> tuple[FlatNetwork, Params]:
    network = FlatNetwork(SIZE, width=8, depth=2)
    params = initial(jax.random.key(0), network, jnp.zeros(feature_count(SIZE)))
    return network, jax.tree.map(lambda x: x + 0.1, params)  # biases count too


def test_folding_constant_features_is_the_network_of_the_whole_observation(network) -> None:
    net, params = network
    rng, lanes = np.random.default_rng(0), 5
    whole = rng.normal(size=(feature_count(SIZE), lanes)).astype(np.float32)
    still = np.setdiff1d(np.arange(len(whole)), dynamic_features(SIZE))
    whole[still] = whole[still, :1]
    constant = whole[:, 0].copy()
    constant[dynamic_features(SIZE)] = 0

    logits, value = forward(net, params, constant, whole[dynamic_features(SIZE)])

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
    loss = lambda p: forward(net, p, constant, jnp.full((len(dynamic_features(SIZE)), 3), 0.01))[1].sum()
    kernel = jax.grad(loss)(params)["params"]["value"]["FirstDense_0"]["kernel"]
    assert (np.abs(kernel) > 0).all()
