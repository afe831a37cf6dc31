"""The kinds of observations by name."""

from dataclasses import replace
from enum import StrEnum
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.entities import entities, symbolic_padded
from levelproof.levelgen.task.observe.flat import level_features, symbolic_flat
from levelproof.levelgen.task.observe.pixels import pixels
from levelproof.physics.types import State


class ObservationType(StrEnum):
    """How a state is observed (`levelgen.task.observe`)."""

    SYMBOLIC_FLAT = "symbolic_flat"
    SYMBOLIC_FLAT_PADDED = "symbolic_flat_padded"
    SYMBOLIC_ENTITY = "symbolic_entity"
    PIXELS = "pixels"


OF_LEVEL_AND_STATE = {
    ObservationType.SYMBOLIC_FLAT_PADDED: symbolic_padded,
    ObservationType.SYMBOLIC_ENTITY: entities,
    ObservationType.PIXELS: jax.vmap(pixels, -1, -1),
}


def constant_features(kind: ObservationType | None, level: Level) -> Float[Array, "feature lane"]:
    """Return the part of an observation that is constant within a level; no rows for kinds that have none."""
    if kind == ObservationType.SYMBOLIC_FLAT:
        return level_features(level)
    return jnp.zeros((0, len(level)))


def observe(
    kind: ObservationType, level: Level, state: State, constant: Float[Array, "feature lane"] | None = None
) -> Any:
    """Observe a state in each lane, lanes last.

    Args:
        kind: what to return.
        level: each lane's level; its `state` is not read.
        state: each lane's world.
        constant: `constant_features(kind, level)`, if the caller has computed them, as once per rollout.
    """
    if kind == ObservationType.SYMBOLIC_FLAT:
        return symbolic_flat(level, state, constant)
    return OF_LEVEL_AND_STATE[kind](replace(level, state=state), state)
