"""Initial kernels."""

import jax
import numpy as np
import pytest

from levelproof.experts.networks.layers import orthogonal


@pytest.mark.parametrize("shape", [(16, 35), (35, 16), (1, 64)])
def test_initial_kernels_are_orthogonal(shape: tuple[int, int]) -> None:
    kernels = jax.jit(jax.vmap(lambda key: orthogonal(2.0)(key, shape)))(jax.random.split(jax.random.key(0), 3))
    for kernel in np.asarray(kernels):
        short = kernel if shape[0] <= shape[1] else kernel.T
        np.testing.assert_allclose(short @ short.T, 4 * np.eye(len(short)), atol=2e-5)
    assert np.abs(kernels[0] - kernels[1]).max() > 0.1
