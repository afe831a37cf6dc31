"""A small convolutional policy on pixels: it sees one picture, and so no velocities."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, SUMMARY, orthogonal
from levelproof.levelgen.task.observe.pixels import PixelsObservation

CONVOLUTIONS = ((16, 8, 4), (32, 4, 2), (32, 3, 2))  # features, side of the kernel, stride; pixels


class PixelPolicy(nn.Module):
    """Logits from pictures, whatever the size of their levels."""

    width: int
    depth: int  # hidden layers after the convolutions

    @nn.compact
    def __call__(self, observation: PixelsObservation) -> Float[Array, "logit lane"]:
        x = jnp.moveaxis(observation.image, -1, 0)
        for features, side, stride in CONVOLUTIONS:
            x = nn.relu(nn.Conv(features, (side, side), (stride, stride))(x))
        y = jnp.concatenate([x.reshape(len(x), -1), observation.global_info.T], -1)
        for _ in range(self.depth):
            y = nn.relu(nn.Dense(self.width, kernel_init=orthogonal(HIDDEN_GAIN))(y))
        self.sow(*SUMMARY, y.T)
        return nn.Dense(LOGITS, kernel_init=orthogonal(POLICY_GAIN))(y).T
