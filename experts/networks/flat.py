"""Networks on the symbolic-flat view.

Most features are constant within a level, so the first layer folds them into its bias once, and multiplies only moving
ones. The function of the whole observation stays the same, at a sixth of its cost for size s.
"""

from typing import NamedTuple

import flax.linen as nn
import numpy as np
from jaxtyping import Array, Float, Int

from levelproof.experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, SUMMARY, VALUE_GAIN, Dense, orthogonal
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.flat import dynamic_features, feature_count, level_features
from levelproof.physics.types import Size
from levelproof.physics.vector import rows


class FirstKernel(NamedTuple):
    """Kernel of a first layer, stored in two parts: slicing one costs more than its products, most of all backwards."""

    moving: Float[Array, "unit dynamic"]
    constant: Float[Array, "unit resting"]


def resting_features(size: Size) -> Int[np.ndarray, " resting"]:
    """Return the rows of the observation that cannot change within a level, ascending."""
    return np.setdiff1d(np.arange(feature_count(size)), dynamic_features(size))


class FirstDense(nn.Module):
    """A layer on the whole observation, split into its constant and its moving rows."""

    size: Size
    units: int
    gain: float

    @nn.compact
    def __call__(
        self, constant: Float[Array, " resting"], moving: Float[Array, "dynamic lane"]
    ) -> Float[Array, "unit lane"]:
        def initial(key: Array) -> FirstKernel:
            whole = orthogonal(self.gain)(key, (self.units, feature_count(self.size)))
            return FirstKernel(whole[:, dynamic_features(self.size)], whole[:, resting_features(self.size)])

        kernel = self.param("kernel", initial)
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        return kernel.moving @ moving + (bias + kernel.constant @ constant)[:, None]


class FlatTrunk(nn.Module):
    size: Size
    width: int
    depth: int
    outputs: int
    gain: float

    @nn.compact
    def __call__(self, constant: Float[Array, " resting"], moving: Float[Array, "dynamic lane"]) -> Array:
        x = nn.tanh(FirstDense(self.size, self.width, HIDDEN_GAIN)(constant, moving))
        for _ in range(self.depth - 1):
            x = nn.tanh(Dense(self.width, HIDDEN_GAIN)(x))
        self.sow(*SUMMARY, x)
        return Dense(self.outputs, self.gain)(x)


class FlatNetwork(nn.Module):
    """Separate networks for policy and value of one level."""

    size: Size
    width: int
    depth: int  # hidden layers

    @staticmethod
    def constant(levels: Level) -> Float[Array, "resting level"]:
        """Select the constant features of each level."""
        return rows(level_features(levels), resting_features(levels.size).tolist())

    @nn.compact
    def __call__(
        self, constant: Float[Array, " resting"], moving: Float[Array, "dynamic lane"]
    ) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
        trunk = lambda outputs, gain, name: FlatTrunk(self.size, self.width, self.depth, outputs, gain, name=name)
        logits = trunk(LOGITS, POLICY_GAIN, "policy")(constant, moving)
        return logits, trunk(1, VALUE_GAIN, "value")(constant, moving)[0]
