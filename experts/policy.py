"""An expert's networks: what to do (multi-discrete logits) and what to expect (value), over the symbolic-flat view.

Lanes last, as in the engine: a layer is `kernel @ x`, and everything between matrix products is a dense loop over
lanes. Most features are constant within a level, so the first layer folds them into its bias once, and multiplies
only those that move. That is the same function of the whole observation, at a sixth of its cost for size s.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict as Params
from jaxtyping import Array, Bool, Float, Int

from levelgen.actions import CHOICES
from levelgen.observe import dynamic_features
from physics.types import Size
from physics.vector import rows

LOGITS = sum(CHOICES)
FIRSTS = np.cumsum([0, *CHOICES[:-1]]).tolist()  # of each entry's logits
HIDDEN_GAIN, POLICY_GAIN, VALUE_GAIN = 2**0.5, 0.01, 1.0  # of orthogonal initial kernels


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """Kernels with orthogonal rows (or columns, if these are fewer) of length `gain`, evenly distributed.

    Gram-Schmidt, twice for accuracy, on a Gaussian matrix. Flax's own does a QR factorisation, and several of these
    side by side can deadlock the thread pool of jaxlib 0.10's CPU backend.
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


class FirstDense(nn.Module):
    """A layer on the whole observation, given as its constant part (0 where it moves) and its moving rows."""

    units: int
    gain: float
    moving_rows: Sequence[int]

    @nn.compact
    def __call__(
        self, constant: Float[Array, " feature"], moving: Float[Array, "dynamic lane"]
    ) -> Float[Array, "unit lane"]:
        kernel = self.param("kernel", orthogonal(self.gain), (self.units, constant.shape[0]))
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        columns = rows(kernel.T, self.moving_rows)
        return columns.T @ moving + (bias + kernel @ constant)[:, None]


class Trunk(nn.Module):
    width: int
    depth: int
    outputs: int
    gain: float
    moving_rows: Sequence[int]

    @nn.compact
    def __call__(self, constant: Float[Array, " feature"], moving: Float[Array, "dynamic lane"]) -> Array:
        x = nn.tanh(FirstDense(self.width, HIDDEN_GAIN, self.moving_rows)(constant, moving))
        for _ in range(self.depth - 1):
            x = nn.tanh(Dense(self.width, HIDDEN_GAIN)(x))
        return Dense(self.outputs, self.gain)(x)


class ActorCritic(nn.Module):
    """Separate networks for policy and value of one level."""

    size: Size
    width: int
    depth: int

    @nn.compact
    def __call__(
        self, constant: Float[Array, " feature"], moving: Float[Array, "dynamic lane"]
    ) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
        moving_rows = tuple(dynamic_features(self.size).tolist())
        logits = Trunk(self.width, self.depth, LOGITS, POLICY_GAIN, moving_rows, name="policy")(constant, moving)
        value = Trunk(self.width, self.depth, 1, VALUE_GAIN, moving_rows, name="value")(constant, moving)
        return logits, value[0]


def forward(
    network: ActorCritic, params: Params, constant: Float[Array, " feature"], moving: Float[Array, "dynamic lane"]
) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
    """Logits and value of one expert."""
    return network.apply(params, constant, moving)  # type: ignore[return-value]


def _entries(logits: Float[Array, "logit lane"]) -> list[Float[Array, "choice lane"]]:
    """Log-probabilities of each action entry's choices."""
    return [jax.nn.log_softmax(logits[k : k + n], axis=0) for k, n in zip(FIRSTS, CHOICES, strict=True)]


def sample(logits: Float[Array, "logit lane"], uniform: Float[Array, "6 lane"]) -> Int[Array, "6 lane"]:
    """Actions by inversion: `uniform` is in [0, 1), one number per entry (a third of what Gumbel noise needs)."""
    actions = []
    for entry, u in zip(_entries(logits), uniform, strict=True):
        up_to = jnp.cumsum(jnp.exp(entry[:-1]), axis=0)
        actions.append((u >= up_to).sum(0, dtype=jnp.int32))
    return jnp.stack(actions)


def most_probable(logits: Float[Array, "logit lane"]) -> Int[Array, "6 lane"]:
    """The first of each entry's most probable choices."""
    return jnp.stack([jnp.argmax(entry, axis=0).astype(jnp.int32) for entry in _entries(logits)])


def log_probability(
    logits: Float[Array, "logit lane"], action: Int[Array, "6 lane"], live: Bool[Array, "6 lane"]
) -> Float[Array, " lane"]:
    """Of what matters of an action: entries are independent, and those that nothing obeys do not count."""
    total = jnp.zeros(logits.shape[-1])
    for entry, chosen, counts in zip(_entries(logits), action, live, strict=True):
        total += jnp.where(counts, sum(jnp.where(chosen == k, row, 0.0) for k, row in enumerate(entry)), 0.0)
    return total


def entropy(logits: Float[Array, "logit lane"], live: Bool[Array, "6 lane"]) -> Float[Array, " lane"]:
    """Sum over the entries that something obeys, nats."""
    entries = zip(_entries(logits), live, strict=True)
    return -sum(jnp.where(counts, (jnp.exp(entry) * entry).sum(0), 0.0) for entry, counts in entries)  # type: ignore[return-value]
