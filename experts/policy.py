"""Distributions over actions, for all policies; and experts' networks, from an observation to logits and a value."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict as Params
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.config import ExpertConfig, Network
from levelproof.experts.networks.entity import EntityNetwork
from levelproof.experts.networks.flat import FlatNetwork
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.observe.flat import dynamic_features
from levelproof.physics.types import Size

ActorCritic = FlatNetwork | EntityNetwork
Constant = Any  # constant features of one level, as the network's `constant` lays them out
FIRSTS = np.cumsum([0, *CHOICES[:-1]]).tolist()  # first logit of each entry


def network_of(size: Size, config: ExpertConfig) -> ActorCritic:
    """Return the configured network."""
    match config.network:
        case Network.FLAT:
            return FlatNetwork(size, config.width, config.depth)
        case Network.ENTITY:
            return EntityNetwork(size, config.width, config.depth, config.encoding)


def initial(key: Key[Array, ""], network: ActorCritic, constant: Constant) -> Params:
    """Draw initial parameters of an expert; of `constant`, only the shapes matter."""
    return network.init(key, constant, jnp.zeros((len(dynamic_features(network.size)), 1)))


def forward(
    network: ActorCritic, params: Params, constant: Constant, moving: Float[Array, "dynamic lane"]
) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
    """Return logits and value of one expert.

    Args:
        network: the network's shape.
        params: the network's parameters.
        constant: constant features of the level.
        moving: features that change, `levelgen.task.observe.flat.state_features`.
    """
    return network.apply(params, constant, moving)  # type: ignore[return-value]


def _entries(logits: Float[Array, "logit lane"]) -> list[Float[Array, "choice lane"]]:
    """Return log-probabilities of each action entry's choices."""
    return [jax.nn.log_softmax(logits[k : k + n], axis=0) for k, n in zip(FIRSTS, CHOICES, strict=True)]


def sample(logits: Float[Array, "logit lane"], uniform: Float[Array, "6 lane"]) -> Int[Array, "6 lane"]:
    """Sample actions by inversion: `uniform` in [0, 1) has one number per entry, a third of what Gumbel noise needs."""
    actions = []
    for entry, u in zip(_entries(logits), uniform, strict=True):
        up_to = jnp.cumsum(jnp.exp(entry[:-1]), axis=0)
        actions.append((u >= up_to).sum(0, dtype=jnp.int32))
    return jnp.stack(actions)


def most_probable(logits: Float[Array, "logit lane"]) -> Int[Array, "6 lane"]:
    """Return each entry's most probable choice, the first if several tie."""
    return jnp.stack([jnp.argmax(entry, axis=0).astype(jnp.int32) for entry in _entries(logits)])


def log_probability(
    logits: Float[Array, "logit lane"], action: Int[Array, "6 lane"], live: Bool[Array, "6 lane"]
) -> Float[Array, " lane"]:
    """Return the log-probability of an action's live entries, which are independent."""
    total = jnp.zeros(logits.shape[-1])
    for entry, chosen, counts in zip(_entries(logits), action, live, strict=True):
        total += jnp.where(counts, sum(jnp.where(chosen == k, row, 0.0) for k, row in enumerate(entry)), 0.0)
    return total


def entropy(logits: Float[Array, "logit lane"], live: Bool[Array, "6 lane"]) -> Float[Array, " lane"]:
    """Return the entropy of the live entries, nats."""
    entries = zip(_entries(logits), live, strict=True)
    return -sum(jnp.where(counts, (jnp.exp(entry) * entry).sum(0), 0.0) for entry, counts in entries)  # type: ignore[return-value]


def divergence(
    logits: Float[Array, "logit lane"], other: Float[Array, "logit lane"], live: Bool[Array, "6 lane"]
) -> Float[Array, " lane"]:
    """Return the Kullback-Leibler divergence of a policy from `other`, KL(policy || other), over live entries, nats."""
    entries = zip(_entries(logits), _entries(other), live, strict=True)
    return sum(jnp.where(counts, (jnp.exp(p) * (p - q)).sum(0), 0.0) for p, q, counts in entries)  # type: ignore[return-value]
