"""Initial kernels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.networks.layers import maximum, orthogonal


@pytest.mark.parametrize("shape", [(16, 35), (35, 16), (1, 64)])
def test_initial_kernels_are_orthogonal(shape: tuple[int, int]) -> None:
    kernels = jax.jit(jax.vmap(lambda key: orthogonal(2.0)(key, shape)))(jax.random.split(jax.random.key(0), 3))
    for kernel in np.asarray(kernels):
        short = kernel if shape[0] <= shape[1] else kernel.T
        np.testing.assert_allclose(short @ short.T, 4 * np.eye(len(short)), atol=2e-5)
    assert np.abs(kernels[0] - kernels[1]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("tokens", [1, 2, 7, 12])
def test_maximum_sends_its_gradient_to_one_of_the_largest_tokens(tokens: int) -> None:
    """That of `jnp.max` divides by their number, which XLA may find to be 0."""
    x = jax.random.randint(jax.random.key(0), (3, tokens, 50), 0, 4).astype(jnp.float32)  # with many ties
    assert (maximum(x) == x.max(1)).all()
    gradient = jax.grad(lambda x: maximum(x).sum())(x)
    assert ((gradient == 0) | (gradient == 1)).all()
    assert (gradient.sum(1) == 1).all()
    assert (x[gradient == 1] == jnp.broadcast_to(x.max(1, keepdims=True), x.shape)[gradient == 1]).all()
