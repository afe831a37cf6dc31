"""The flat network equals the plain formula on the whole observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.typing import VariableDict as Params

from levelproof.experts.networks.flat import FlatNetwork, resting_features
from levelproof.experts.policy import forward, initial
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.observe.flat import dynamic_features, feature_count, level_features
from tests.experts.networks.weights import random_weights

SIZE = SIZES["s"]
MOVING, STILL = dynamic_features(SIZE), resting_features(SIZE)


@pytest.fixture(scope="module")
def network() -> tuple[FlatNetwork, Params]:
    network = FlatNetwork(SIZE, width=8, depth=2)
    constant = np.zeros(len(STILL), np.float32)
    return network, random_weights(lambda: initial(jax.random.key(0), network, constant), 0.1)


def whole_kernel(layer: dict) -> np.ndarray:
    kernel = np.empty((8, feature_count(SIZE)), np.float32)
    kernel[:, MOVING], kernel[:, STILL] = layer["kernel"].moving, layer["kernel"].constant
    return kernel


def test_folding_constant_features_keeps_the_network_of_the_whole_observation(network) -> None:
    net, params = network
    rng, lanes = np.random.default_rng(0), 5
    whole = rng.normal(size=(feature_count(SIZE), lanes)).astype(np.float32)
    whole[STILL] = whole[STILL, :1]

    logits, value = jax.jit(forward, static_argnums=0)(net, params, whole[STILL, 0], whole[MOVING])

    def plain(name):
        first, second, last = (params["params"][name][layer] for layer in ("FirstDense_0", "Dense_0", "Dense_1"))
        x = np.tanh(whole_kernel(first) @ whole + first["bias"][:, None])
        x = np.tanh(second["kernel"] @ x + second["bias"][:, None])
        return last["kernel"] @ x + last["bias"][:, None]

    np.testing.assert_allclose(logits, plain("policy"), atol=1e-5)
    np.testing.assert_allclose(value, plain("value")[0], atol=1e-5)


def test_first_kernel_has_orthogonal_rows_across_both_parts() -> None:
    constant = np.zeros(len(STILL), np.float32)
    params = jax.jit(initial, static_argnums=1)(jax.random.key(0), FlatNetwork(SIZE, width=8, depth=1), constant)
    kernel = whole_kernel(params["params"]["policy"]["FirstDense_0"])  # type: ignore[index]
    np.testing.assert_allclose(kernel @ kernel.T, 2 * np.eye(8), atol=1e-5)


def test_constant_selects_features_that_do_not_move() -> None:
    levels = sample_levels(np.arange(3), SIZE)
    features = np.asarray(jax.jit(level_features)(levels))
    np.testing.assert_array_equal(jax.jit(FlatNetwork.constant)(levels), features[STILL])
    assert not features[MOVING].any()


def test_gradient_reaches_kernels_of_constant_features(network) -> None:
    net, params = network
    loss = lambda p: forward(net, p, jnp.full(len(STILL), 0.01), jnp.full((len(MOVING), 3), 0.01))[1].sum()
    kernel = whole_kernel(jax.jit(jax.grad(loss))(params)["params"]["value"]["FirstDense_0"])
    assert (np.abs(kernel) > 0).all()
