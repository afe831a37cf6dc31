"""Networks on the symbolic-flat view.

Most features are constant within a level, so the first layer folds them into its bias once, and multiplies only those
that move. That is the same function of the whole observation, at a sixth of its cost for size s.
"""

from collections.abc import Sequence

import flax.linen as nn
from jaxtyping import Array, Float

from experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, VALUE_GAIN, Dense, orthogonal
from levelgen.level import Level
from levelgen.observe import dynamic_features, level_features
from physics.types import Size
from physics.vector import rows


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


class FlatNetwork(nn.Module):
    """Separate networks for policy and value of one level."""

    size: Size
    width: int
    depth: int  # hidden layers

    @staticmethod
    def constant(levels: Level) -> Float[Array, "feature level"]:
        """What is constant within each level; zeros where it moves."""
        return level_features(levels)

    @nn.compact
    def __call__(
        self, constant: Float[Array, " feature"], moving: Float[Array, "dynamic lane"]
    ) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
        moving_rows = tuple(dynamic_features(self.size).tolist())
        logits = Trunk(self.width, self.depth, LOGITS, POLICY_GAIN, moving_rows, name="policy")(constant, moving)
        value = Trunk(self.width, self.depth, 1, VALUE_GAIN, moving_rows, name="value")(constant, moving)
        return logits, value[0]
