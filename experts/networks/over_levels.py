"""Networks of one policy for all levels: from levels and states to logits, behind one function.

`attention` and `invariant` fit levels of any size, `flat` those of one. The last two are the experts' networks, with
the constants of each lane's own level in place of one level's.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import jax
from flax.typing import VariableDict
from jaxtyping import Array, Float, Key

from levelproof.experts.networks.attention import AttentionPolicy
from levelproof.experts.networks.entity import EntityNetwork, EntityTrunk, moving_things
from levelproof.experts.networks.flat import FlatNetwork, FlatTrunk
from levelproof.experts.networks.layers import LOGITS, POLICY_GAIN
from levelproof.experts.networks.relations import entity_tables
from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.environment import ObservationType
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.physics.bounds import require
from levelproof.physics.types import Size, State


class PolicyKind(StrEnum):
    """Network of a policy for all levels."""

    ATTENTION = "attention"  # entities that attend to each other; actuators have logits of their own
    INVARIANT = "invariant"  # the experts' network on a set of entities; their order does not matter
    FLAT = "flat"  # all features in one vector; for levels of one size


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network (hashable: pass as a static argument)."""

    kind: PolicyKind = PolicyKind.ATTENTION  # network of the policy
    width: int = 48  # units of a token, or of a hidden layer
    depth: int = 2  # blocks of attention, or hidden layers
    heads: int = 4  # heads of attention

    def __post_init__(self) -> None:
        require(self, ("width", "depth", "heads"), 1)
        if self.kind is PolicyKind.ATTENTION and self.width % self.heads:
            raise ValueError(f"width is {self.width}: it must be a multiple of heads = {self.heads}")

    @property
    def observation_type(self) -> ObservationType:
        """What the network reads of a state, as an observation of the environment."""
        flat = self.kind is PolicyKind.FLAT
        return ObservationType.SYMBOLIC_FLAT if flat else ObservationType.SYMBOLIC_ENTITY


def initial_policy(key: Key[Array, ""], config: NetworkConfig, size: Size) -> VariableDict:
    """Return initial parameters; `size` matters to a flat network only."""
    level = empty_level(size, 1)
    if config.kind is PolicyKind.ATTENTION:
        return _attention(config).init(key, entity_tables(level, level.state))
    trunk, constant, moving = _trunk(config, level, level.state)
    return trunk.init(key, *_of_one_lane(config, size, *jax.tree.map(lambda x: x[..., 0], (constant, moving))))


def policy_logits(
    params: VariableDict, config: NetworkConfig, level: Level, state: State
) -> Float[Array, "logit lane"]:
    """Return the logits of each action entry's choices, entry after entry (`experts.policy` reads them).

    Args:
        params: the network's parameters.
        config: the network's shape.
        level: each lane's level, lanes last; its `state` is not read.
        state: each lane's world.
    """
    if config.kind is PolicyKind.ATTENTION:
        logits: Any = _attention(config).apply(params, entity_tables(level, state))
        return logits.T
    trunk, constant, moving = _trunk(config, level, state)

    def one(constant: Any, moving: Float[Array, " dynamic"]) -> Float[Array, " logit"]:
        logits: Any = trunk.apply(params, *_of_one_lane(config, level.size, constant, moving))
        return logits[:, 0]

    return jax.vmap(one, in_axes=-1, out_axes=-1)(constant, moving)


def _attention(config: NetworkConfig) -> AttentionPolicy:
    return AttentionPolicy(config.width, config.depth, config.heads)


def _trunk(config: NetworkConfig, level: Level, state: State) -> tuple[FlatTrunk | EntityTrunk, Any, Array]:
    """Return the module, and each lane's constants and moving features."""
    moving, shape = state_features(level, state), (config.width, config.depth)
    if config.kind is PolicyKind.FLAT:
        return FlatTrunk(level.size, *shape, LOGITS, POLICY_GAIN), FlatNetwork.constant(level), moving
    return EntityTrunk(*shape, config.width, LOGITS, POLICY_GAIN), EntityNetwork.constant(level), moving


def _of_one_lane(config: NetworkConfig, size: Size, constant: Any, moving: Float[Array, " dynamic"]) -> tuple[Any, Any]:
    lane = moving[:, None]
    return constant, lane if config.kind is PolicyKind.FLAT else moving_things(size, constant, lane)
