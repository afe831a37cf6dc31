"""A policy that attends over a level's entities, of any number and order.

Every entity is a token. After some blocks of attention, each actuator's logits are read from its own token and a
summary of all, and added up over the actuators that obey one entry of the action.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from levelproof.experts.networks.layers import POLICY_GAIN
from levelproof.experts.networks.relations import EntityTables
from levelproof.levelgen.task.actions import MOTOR_CHOICES, THRUSTER_CHOICES

HIDDEN_BY_MASK = -1e9  # score, or value in a maximum, of what is masked
NAMES = ("polygons", "circles", "joints", "thrusters")


class AttentionBlock(nn.Module):
    """Attention among active tokens, then a layer on each; both are added to their inputs, which are normalised."""

    width: int
    heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "lane token unit"], active: Bool[Array, "lane token"], linked: Bool[Array, "lane i j"]
    ) -> Float[Array, "lane token unit"]:
        lanes, tokens, _ = x.shape
        seen = nn.Dense(3 * self.width, name="queries_keys_values")(nn.LayerNorm()(x))
        query, key, value = jnp.moveaxis(seen.reshape(lanes, tokens, 3, self.heads, -1), 2, 0)
        # One bias for each head lets a body and what is fixed to it find each other
        bias = self.param("linked", nn.initializers.ones, (self.heads,))
        score = jnp.einsum("lihd,ljhd->lhij", query, key) / query.shape[-1] ** 0.5
        score = score + bias[:, None, None] * linked[:, None]
        share = nn.softmax(jnp.where(active[:, None, None], score, HIDDEN_BY_MASK), -1)
        mixed = jnp.einsum("lhij,ljhd->lihd", share, value).reshape(lanes, tokens, -1)
        x = x + nn.Dense(self.width, name="mix")(mixed)
        return x + nn.Dense(self.width, name="out")(nn.relu(nn.Dense(2 * self.width, name="in")(nn.LayerNorm()(x))))


class AttentionPolicy(nn.Module):
    """Logits from entities; the parameters fit any size."""

    width: int
    blocks: int
    heads: int

    @nn.compact
    def __call__(self, seen: EntityTables) -> Float[Array, "lane logit"]:
        encoded = [nn.Dense(self.width, name=name)(x) for name, x in zip(NAMES, seen.features, strict=True)]
        x = jnp.concatenate(encoded, 1)
        for i in range(self.blocks):
            x = AttentionBlock(self.width, self.heads, name=f"block_{i}")(x, seen.active, seen.linked)
        x = nn.LayerNorm()(x)
        weight = seen.active[..., None]
        mean = (x * weight).sum(1) / jnp.maximum(weight.sum(1), 1)
        summary = jnp.concatenate([mean, jnp.where(weight, x, HIDDEN_BY_MASK).max(1)], -1)
        summary = nn.relu(nn.Dense(self.width, name="summary")(summary))
        joints, thrusters = seen.motors.shape[1], seen.thrusts.shape[1]
        first = x.shape[1] - joints - thrusters
        motors = ActuatorHead(self.width, MOTOR_CHOICES, name="motor")(x[:, first : first + joints], summary)
        thrusts = ActuatorHead(self.width, THRUSTER_CHOICES, name="thrust")(x[:, first + joints :], summary)
        by_entry = [jnp.einsum("lte,ltc->lec", *pair) for pair in ((seen.motors, motors), (seen.thrusts, thrusts))]
        return jnp.concatenate([logits.reshape(len(x), -1) for logits in by_entry], -1)


class ActuatorHead(nn.Module):
    """Logits of each actuator, from its own token and the summary of all tokens."""

    width: int
    choices: int

    @nn.compact
    def __call__(
        self, tokens: Float[Array, "lane actuator unit"], summary: Float[Array, "lane unit"]
    ) -> Float[Array, "lane actuator choice"]:
        together = nn.Dense(self.width)(tokens) + nn.Dense(self.width, use_bias=False)(summary)[:, None]
        last = nn.initializers.orthogonal(POLICY_GAIN)
        return nn.Dense(self.choices, kernel_init=last)(nn.relu(together))
