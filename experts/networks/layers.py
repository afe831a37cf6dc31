"""Layers on columns, their initial kernels, and a maximum.

Lanes are last, as in the engine: a layer is `kernel @ x`, and all else is a dense loop over lanes.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.levelgen.task.actions import CHOICES

LOGITS = sum(CHOICES)
# Flax collection and name of a network's last hidden layer, [unit, lane], the input of a value function
SUMMARY = ("intermediates", "known")
HIDDEN_GAIN, POLICY_GAIN, VALUE_GAIN = 2**0.5, 0.01, 1.0  # of orthogonal initial kernels


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """Return an initializer of Haar-random kernels with orthogonal rows (columns, if fewer) of norm `gain`.

    It runs Gram-Schmidt, twice for accuracy, on a Gaussian matrix. Flax's initializer does a QR factorisation, and
    several side by side can deadlock the thread pool of jaxlib 0.10's CPU backend.
    """

    def initialise(key, shape, dtype=jnp.float32):
        units, inputs = shape
        if units > inputs:
            return initialise(key, (inputs, units), dtype).T

        def add_row(k, kernel):
            earlier = jnp.where(jnp.arange(units)[:, None] < k, kernel, 0.0)
            row = kernel[k]
            for _ in range(2):
                row = row - earlier.T @ (earlier @ row)
            return kernel.at[k].set(row / jnp.linalg.norm(row))

        return gain * jax.lax.fori_loop(0, units, add_row, jax.random.normal(key, shape, dtype))

    return initialise


class Dense(nn.Module):
    """A layer on columns."""

    units: int
    gain: float

    @nn.compact
    def __call__(self, x: Float[Array, "input lane"]) -> Float[Array, "unit lane"]:
        kernel = self.param("kernel", orthogonal(self.gain), (self.units, x.shape[0]))
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        return kernel @ x + bias[:, None]


def maximum(x: Float[Array, "unit token lane"]) -> Float[Array, "unit lane"]:
    """Return the maximum over tokens, whose gradient goes to one of them.

    The gradient of `jnp.max` divides by the number of tokens that equal the maximum. If XLA recomputes the tokens and
    rounds differently, that number can be 0, and the gradient NaN.
    """
    while x.shape[1] > 1:
        half = x.shape[1] // 2
        first, second, rest = x[:, :half], x[:, half : 2 * half], x[:, 2 * half :]
        x = jnp.concatenate([jnp.where(first >= second, first, second), rest], 1)
    return x[:, 0]
