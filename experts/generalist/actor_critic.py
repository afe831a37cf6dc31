"""A policy for all levels with a value function, whose input is the policy's own summary of a lane."""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import VariableDict
from jaxtyping import Array, Float, Key

from levelproof.experts.networks.layers import HIDDEN_GAIN, VALUE_GAIN, Dense
from levelproof.experts.networks.over_levels import NetworkConfig, initial_policy, logits_and_summary, seen
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.physics.types import Size


class ActorCriticParams(NamedTuple):
    """Parameters of a policy and of its value function; a policy's folder contains only `policy`."""

    policy: VariableDict
    value: VariableDict


class ValueHead(nn.Module):
    """A value from a lane's summary."""

    width: int

    @nn.compact
    def __call__(self, summary: Float[Array, "unit lane"]) -> Float[Array, " lane"]:
        return Dense(1, VALUE_GAIN)(nn.tanh(Dense(self.width, HIDDEN_GAIN)(summary)))[0]


def initial_actor_critic(
    key: Key[Array, ""], network: NetworkConfig, size: Size, policy: VariableDict | None = None
) -> ActorCriticParams:
    """Return initial parameters; those of `policy`, if given. `size` matters to a flat network only."""
    of_policy, of_value = jax.random.split(key)
    policy = initial_policy(of_policy, network, size) if policy is None else policy
    level = empty_level(size, 1)
    _, summary = logits_and_summary(policy, network, size, seen(network, level, level.state))
    return ActorCriticParams(policy, ValueHead(network.width).init(of_value, summary))


def logits_and_value(
    params: ActorCriticParams, network: NetworkConfig, size: Size, observation: Any
) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
    """Return logits and value from what the network has `seen`."""
    logits, summary = logits_and_summary(params.policy, network, size, observation)
    value: Any = ValueHead(network.width).apply(params.value, summary)
    return logits, jnp.asarray(value)
