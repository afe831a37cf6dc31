"""Networks of one policy for all levels: from levels and states to logits, behind one function.

All but `flat` fit levels of any size. `invariant` and `flat` are the experts' networks, with the constants of each
lane's own level in place of one level's.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import flax.linen as nn
import jax
from flax.typing import VariableDict
from jaxtyping import Array, Float, Key

from levelproof.experts.networks.attention import AttentionPolicy
from levelproof.experts.networks.entity import EntityNetwork, EntityTrunk, moving_things
from levelproof.experts.networks.flat import FlatNetwork, FlatTrunk
from levelproof.experts.networks.layers import LOGITS, POLICY_GAIN, SUMMARY
from levelproof.experts.networks.pictures import PixelPolicy
from levelproof.experts.networks.relations import entity_tables
from levelproof.experts.networks.transformer import MASKS, TransformerPolicy
from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.observe.entities import entities
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.levelgen.task.observe.pixels import pixels
from levelproof.physics.bounds import require
from levelproof.physics.types import Size, State


class PolicyKind(StrEnum):
    """Network of a policy for all levels."""

    ATTENTION = "attention"  # entities that attend to each other; actuators have logits of their own
    INVARIANT = "invariant"  # the experts' network on a set of entities; their order does not matter
    FLAT = "flat"  # all features in one vector; for levels of one size
    TRANSFORMER = "transformer"  # the reference's
    PIXELS = "pixels"  # convolutions on a picture


MAX_WIDTH, MAX_DEPTH, MAX_HEADS = 1024, 16, 64  # a policy's folder may be untrusted
LANE_BY_LANE = (PolicyKind.INVARIANT, PolicyKind.FLAT)  # kinds whose module sees one level at a time


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network (hashable: pass as a static argument)."""

    kind: PolicyKind = PolicyKind.ATTENTION  # network of the policy
    width: int = 48  # units of a token, or of a hidden layer
    depth: int = 2  # blocks of attention, or hidden layers
    heads: int = 4  # heads of attention

    def __post_init__(self) -> None:
        for name, most in ("width", MAX_WIDTH), ("depth", MAX_DEPTH), ("heads", MAX_HEADS):
            require(self, (name,), 1, most)
        if self.kind is PolicyKind.ATTENTION and self.width % self.heads:
            raise ValueError(f"width is {self.width}: it must be a multiple of heads = {self.heads}")
        if self.kind is PolicyKind.TRANSFORMER and self.heads % MASKS:
            raise ValueError(f"heads is {self.heads}: it must be a multiple of {MASKS} for the transformer")

    def only_size(self, size: Size) -> Size | None:
        """Return the one size that a network trained on levels of `size` fits; None: it fits any."""
        return size if self.kind is PolicyKind.FLAT else None

    @property
    def observation_type(self) -> ObservationType:
        """What the network reads of a state, as an observation of the environment."""
        match self.kind:
            case PolicyKind.FLAT:
                return ObservationType.SYMBOLIC_FLAT
            case PolicyKind.PIXELS:
                return ObservationType.PIXELS
        return ObservationType.SYMBOLIC_ENTITY

    @property
    def reads_contacts(self) -> bool:
        """Whether the network reads which bodies touch."""
        return self.kind is PolicyKind.TRANSFORMER


def initial_policy(key: Key[Array, ""], config: NetworkConfig, size: Size) -> VariableDict:
    """Return initial parameters; `size` matters to a flat network only."""
    level = empty_level(size, 1)
    observation = seen(config, level, level.state)
    if config.kind in LANE_BY_LANE:
        observation = _of_one_lane(config, size, *jax.tree.map(lambda x: x[..., 0], observation))
    else:
        observation = (observation,)
    return _module(config, size).init(key, *observation)


def policy_logits(
    params: VariableDict, config: NetworkConfig, level: Level, state: State
) -> Float[Array, "logit lane"]:
    """Return the logits of each action entry's choices, entry after entry (`experts.policy` reads them).

    Args:
        params: the network's parameters.
        config: the network's shape.
        level: each lane's level, lanes last; of its `state` only scenery is read, which never moves.
        state: each lane's world.
    """
    return logits_and_summary(params, config, level.size, seen(config, level, state))[0]


def seen(config: NetworkConfig, level: Level, state: State) -> Any:
    """Return what the network sees in each lane, lanes last. Arguments as `policy_logits`."""
    match config.kind:
        case PolicyKind.TRANSFORMER:
            return entities(level, state)
        case PolicyKind.PIXELS:
            return jax.vmap(pixels, in_axes=-1, out_axes=-1)(replace(level, state=state), state)
        case PolicyKind.FLAT:
            return FlatNetwork.constant(level), state_features(level, state)
        case PolicyKind.INVARIANT:
            return EntityNetwork.constant(level), state_features(level, state)
    return entity_tables(level, state)


def logits_and_summary(
    params: VariableDict, config: NetworkConfig, size: Size, observation: Any
) -> tuple[Float[Array, "logit lane"], Float[Array, "unit lane"]]:
    """Return logits, and what the network knows of each lane before them, from what it has `seen`."""
    module = _module(config, size)

    def apply(*inputs: Any) -> tuple[Array, Array]:
        logits, kept = module.apply(params, *inputs, mutable=[SUMMARY[0]])
        return logits, kept[SUMMARY[0]][SUMMARY[1]][0]  # pyright: ignore

    if config.kind not in LANE_BY_LANE:
        return apply(observation)
    one = lambda *lane: jax.tree.map(lambda x: x[:, 0], apply(*_of_one_lane(config, size, *lane)))
    return jax.vmap(one, in_axes=-1, out_axes=-1)(*observation)


def _module(config: NetworkConfig, size: Size) -> nn.Module:
    shape = config.width, config.depth
    match config.kind:
        case PolicyKind.TRANSFORMER:
            return TransformerPolicy(*shape, config.heads)
        case PolicyKind.PIXELS:
            return PixelPolicy(*shape)
        case PolicyKind.FLAT:
            return FlatTrunk(size, *shape, LOGITS, POLICY_GAIN)
        case PolicyKind.INVARIANT:
            return EntityTrunk(*shape, config.width, LOGITS, POLICY_GAIN, any_size=True)
    return AttentionPolicy(*shape, config.heads)


def _of_one_lane(config: NetworkConfig, size: Size, constant: Any, moving: Float[Array, " dynamic"]) -> tuple[Any, Any]:
    lane = moving[:, None]
    return constant, lane if config.kind is PolicyKind.FLAT else moving_things(size, constant, lane)
