"""A policy that attends over a level's entities, of any number and order.

Every entity is a token. After some blocks of attention, each actuator's logits are read from its own token and a
summary of all, and added up over the actuators that obey one entry of the action. Lanes are last: layers are products
of large matrices, and attention among so few tokens is a dense loop over lanes.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from levelproof.experts.networks.layers import POLICY_GAIN, SUMMARY, maximum, orthogonal
from levelproof.experts.networks.relations import EntityTables
from levelproof.levelgen.task.actions import MOTOR_CHOICES, THRUSTER_CHOICES

HIDDEN_BY_MASK = -1e9  # score, or value in a maximum, of what is masked
NAMES = ("polygons", "circles", "joints", "thrusters")


def _scores(a: Float[Array, "head unit i lane"], b: Float[Array, "head unit j lane"]) -> Array:
    """Return the products of every two tokens, one dense loop over lanes: einsum would multiply tiny matrices."""
    pairs = sum(a[:, unit, :, None] * b[:, unit, None] for unit in range(a.shape[1]))
    return jax.lax.optimization_barrier(pairs)  # else XLA computes them again for every reader


def _mixtures(share: Float[Array, "head i j lane"], value: Float[Array, "head unit j lane"]) -> Array:
    """Return each token's sum of values, weighted by its shares [head, i, j]; dense over lanes, like `_scores`."""
    mixed = sum(share[:, None, :, j] * value[:, :, j, None] for j in range(share.shape[2]))
    return jax.lax.optimization_barrier(mixed)


@jax.custom_vjp
def scores(query: Float[Array, "head unit i lane"], key: Float[Array, "head unit j lane"]) -> Array:
    """Return each query's product with each key: [head, i, j, lane]."""
    return _scores(query, key)


@jax.custom_vjp
def mixtures(share: Float[Array, "head i j lane"], value: Float[Array, "head unit j lane"]) -> Array:
    """Return each token's mixture of the values: [head, unit, i, lane]."""
    return _mixtures(share, value)


# Derivatives are loops of the same two kinds; those that JAX would derive take several times as long
scores.defvjp(
    lambda query, key: (_scores(query, key), (query, key)),
    lambda inputs, change: (_mixtures(change, inputs[1]), _mixtures(change.swapaxes(1, 2), inputs[0])),
)
mixtures.defvjp(
    lambda share, value: (_mixtures(share, value), (share, value)),
    lambda inputs, change: (_scores(change, inputs[1]), _mixtures(inputs[0].swapaxes(1, 2), change)),
)


class OnColumns(nn.Module):
    """Flax's `Dense` with units first and lanes last, and with the same parameters."""

    units: int
    use_bias: bool = True
    kernel_init: nn.initializers.Initializer = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, x: Float[Array, "input ... lane"]) -> Float[Array, "unit ... lane"]:
        kernel = self.param("kernel", self.kernel_init, (len(x), self.units))
        y = (kernel.T @ x.reshape(len(x), -1)).reshape(self.units, *x.shape[1:])
        if not self.use_bias:
            return y
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        return y + bias.reshape(-1, *[1] * (x.ndim - 1))


def _normalised(x: Float[Array, "unit ... lane"]) -> Array:
    """Normalise each token; called within a compact method."""
    return nn.LayerNorm(reduction_axes=0, feature_axes=0)(x)


class AttentionBlock(nn.Module):
    """Attention among active tokens, then a layer on each; both are added to their inputs, which are normalised."""

    width: int
    heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "unit token lane"], active: Bool[Array, "token lane"], linked: Bool[Array, "i j lane"]
    ) -> Float[Array, "unit token lane"]:
        projected = OnColumns(3 * self.width, name="queries_keys_values")(_normalised(x))
        query, key, value = projected.reshape(3, self.heads, -1, *x.shape[1:])
        # One bias for each head lets a body and what is fixed to it find each other
        bias = self.param("linked", nn.initializers.ones, (self.heads,))
        score = scores(query / query.shape[1] ** 0.5, key) + bias[:, None, None, None] * linked
        share = jax.lax.optimization_barrier(nn.softmax(jnp.where(active, score, HIDDEN_BY_MASK), 2))
        x = x + OnColumns(self.width, name="mix")(mixtures(share, value).reshape(x.shape))
        hidden = nn.relu(OnColumns(2 * self.width, name="in")(_normalised(x)))
        return x + OnColumns(self.width, name="out")(hidden)


class AttentionPolicy(nn.Module):
    """Logits from entities; the parameters fit any size."""

    width: int
    blocks: int
    heads: int

    @nn.compact
    def __call__(self, tables: EntityTables) -> Float[Array, "logit lane"]:
        encoded = [OnColumns(self.width, name=name)(x) for name, x in zip(NAMES, tables.features, strict=True)]
        x = jnp.concatenate(encoded, 1)
        for i in range(self.blocks):
            x = AttentionBlock(self.width, self.heads, name=f"block_{i}")(x, tables.active, tables.linked)
        x = _normalised(x)
        mean = (x * tables.active).sum(1) / jnp.maximum(tables.active.sum(0), 1)
        summary = jnp.concatenate([mean, maximum(jnp.where(tables.active, x, HIDDEN_BY_MASK))])
        summary = nn.relu(OnColumns(self.width, name="summary")(summary))
        self.sow(*SUMMARY, summary)
        joints, thrusters = len(tables.motors), len(tables.thrusts)
        first = x.shape[1] - joints - thrusters
        motors = ActuatorHead(self.width, MOTOR_CHOICES, name="motor")(x[:, first : first + joints], summary)
        thrusts = ActuatorHead(self.width, THRUSTER_CHOICES, name="thrust")(x[:, first + joints :], summary)
        by_entry = [obeying(*pair) for pair in ((tables.motors, motors), (tables.thrusts, thrusts))]
        return jnp.concatenate(by_entry)


class ActuatorHead(nn.Module):
    """Logits of each actuator, from its own token and the summary of all tokens."""

    width: int
    choices: int

    @nn.compact
    def __call__(
        self, tokens: Float[Array, "unit actuator lane"], summary: Float[Array, "unit lane"]
    ) -> Float[Array, "choice actuator lane"]:
        own = OnColumns(self.width, name="Dense_0")(tokens)
        shared = OnColumns(self.width, use_bias=False, name="Dense_1")(summary)
        return OnColumns(self.choices, kernel_init=orthogonal(POLICY_GAIN), name="Dense_2")(
            nn.relu(own + shared[:, None])
        )


def obeying(bound: Float[Array, "actuator entry lane"], logits: Float[Array, "choice actuator lane"]) -> Array:
    """Add up the logits of the actuators that obey each entry: [logit, lane], entry after entry."""
    none = jnp.zeros((bound.shape[1], *logits.shape[::2]))
    by_entry = sum((bound[i, :, None] * logits[None, :, i] for i in range(len(bound))), none)
    return by_entry.reshape(-1, logits.shape[-1])
