"""The reference's transformer: gated attention among bodies, and messages along joints and from thrusters.

With width 128, 2 blocks and 8 heads it has the shape of `tf-paper`, without the value head. Each quarter of the heads
has a mask of its own: all bodies, those in the same chain of joints, those joined directly, those in contact. Inside,
lanes come first, because the attention is Flax's.
Facts: `kinetix.models.transformer_model` 3.0.2.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, SUMMARY, orthogonal
from levelproof.levelgen.task.observe.entities import EntityObservation

PER_HEAD = 2  # units of a query, a key or a value of a head
HEAD_LAYERS = 5  # hidden layers after the blocks
MASKS = 4  # kinds of attention


class Gate(nn.Module):
    """A gated update, as of a recurrent unit, in place of a residual sum."""

    width: int

    @nn.compact
    def __call__(self, x: Float[Array, "lane token unit"], y: Float[Array, "lane token unit"]) -> Array:
        dense = lambda name: nn.Dense(self.width, use_bias=False, name=name)
        reset = nn.sigmoid(dense("reset_y")(y) + dense("reset_x")(x))
        bias = self.param("bias", nn.initializers.zeros, (self.width,))
        share = nn.sigmoid(dense("share_y")(y) + dense("share_x")(x) - bias)
        new = nn.tanh(dense("new_y")(y) + dense("new_x")(reset * x))
        return (1 - share) * x + share * new


class GatedBlock(nn.Module):
    """Attention among bodies, then a layer on each, both behind a gate."""

    width: int
    heads: int

    @nn.compact
    def __call__(self, x: Float[Array, "lane token unit"], mask: Bool[Array, "lane head token token"]) -> Array:
        attention = nn.MultiHeadDotProductAttention(self.heads, qkv_features=PER_HEAD * self.heads)
        y = Gate(self.width, name="gate_attention")(x, nn.relu(attention(nn.LayerNorm()(x), mask=mask)))
        return Gate(self.width, name="gate_layer")(y, nn.relu(nn.Dense(self.width)(nn.LayerNorm()(y))))


class TransformerPolicy(nn.Module):
    """Logits from sets of entities; the parameters fit any size."""

    width: int
    blocks: int
    heads: int

    @nn.compact
    def __call__(self, observation: EntityObservation) -> Float[Array, "logit lane"]:
        observation = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), observation)
        polygons, circles = (
            self._encode("polygons", observation.polygons, 1),
            self._encode("circles", observation.circles, 0),
        )
        joints, thrusters = self._encode("joints", observation.joints), self._encode("thrusters", observation.thrusters)
        lanes = len(polygons)
        x = jnp.concatenate([jnp.ones((lanes, 1, self.width)), polygons, circles], 1)  # first, a token of the scene
        active = jnp.concatenate([jnp.ones((lanes, 1), bool), observation.polygon_mask, observation.circle_mask], 1)
        mask = jnp.pad(observation.attention_mask, [(0, 0), (0, 0), (1, 0), (1, 0)], constant_values=True)
        mask = jnp.repeat(mask & active[:, None, :, None] & active[:, None, None], self.heads // MASKS, 1)
        ends, hulls = observation.joint_indexes + 1, observation.thruster_indexes + 1
        for i in range(self.blocks):
            x = GatedBlock(self.width, self.heads, name=f"block_{i}")(x, mask)
            along = jnp.concatenate([_rows_at(x, ends[..., 0]), _rows_at(x, ends[..., 1]), joints], -1)
            pushed = jnp.concatenate([_rows_at(x, hulls), thrusters], -1)
            messages = nn.Dense(self.width, name=f"joints_{i}")(along) * observation.joint_mask[..., None]
            pushes = nn.Dense(self.width, name=f"thrusters_{i}")(pushed) * observation.thruster_mask[..., None]
            x = _added(_added(x, ends[..., 0], messages), hulls, pushes)
        y = jnp.mean(x, 1, where=active[..., None])
        for i in range(HEAD_LAYERS):
            y = nn.tanh(nn.Dense(self.width, kernel_init=orthogonal(HIDDEN_GAIN), name=f"head_{i}")(y))
        self.sow(*SUMMARY, y.T)
        return nn.Dense(LOGITS, kernel_init=orthogonal(POLICY_GAIN), name="logits")(y).T

    def _encode(self, name: str, features: Float[Array, "lane entity feature"], kind: int | None = None) -> Any:
        """Encode entities; bodies have their kind as last unit."""
        units = self.width - (kind is not None)
        encoded = nn.tanh(nn.Dense(units, kernel_init=orthogonal(HIDDEN_GAIN), name=name)(features))
        if kind is None:
            return encoded
        return jnp.concatenate([encoded, jnp.full((*encoded.shape[:2], 1), float(kind))], -1)


def _rows_at(x: Float[Array, "lane token unit"], index: Int[Array, "lane entity"]) -> Float[Array, "lane entity unit"]:
    return jnp.take_along_axis(x, index[..., None], 1)


def _added(x: Float[Array, "lane token unit"], index: Int[Array, "lane entity"], messages: Array) -> Array:
    at = nn.one_hot(index, x.shape[1])
    return x + jnp.einsum("ltk,ltu->lku", at, messages)
