"""An expert's policy: what to do (multi-discrete logits) and what to expect (value), from what it sees of a state."""

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
Constant = Any  # what is constant within one level, as the network's `constant` lays it out
FIRSTS = np.cumsum([0, *CHOICES[:-1]]).tolist()  # of each entry's logits


def network_of(size: Size, config: ExpertConfig) -> ActorCritic:
    """The network that a configuration asks for."""
    match config.network:
        case Network.FLAT:
            return FlatNetwork(size, config.width, config.depth)
        case Network.ENTITY:
            return EntityNetwork(size, config.width, config.depth, config.encoding)


def initial(key: Key[Array, ""], network: ActorCritic, constant: Constant) -> Params:
    """Parameters of an expert that has seen nothing; `constant` gives shapes only."""
    return network.init(key, constant, jnp.zeros((len(dynamic_features(network.size)), 1)))


def forward(
    network: ActorCritic, params: Params, constant: Constant, moving: Float[Array, "dynamic lane"]
) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
    """Logits and value of one expert.

    Args:
        network: its shape.
        params: its parameters.
        constant: of its level.
        moving: the rows that change, `levelgen.task.observe.flat.state_features`.
    """
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
