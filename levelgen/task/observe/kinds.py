"""The kinds of observations by name."""

from dataclasses import replace
from enum import StrEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.entities import entities, symbolic_padded
from levelproof.levelgen.task.observe.flat import (
    join_features,
    level_features,
    state_features,
    symbolic_flat,
)
from levelproof.levelgen.task.observe.pixels import pixels
from levelproof.physics.types import Size, State


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


def constant_features(kind: ObservationType, level: Level) -> Float[Array, "feature lane"]:
    """Return the part of an observation that is constant within a level; no rows for kinds that have none."""
    if kind == ObservationType.SYMBOLIC_FLAT:
        return level_features(level)
    return jnp.zeros((0, len(level)))


def changing_features(kind: ObservationType, level: Level, state: State) -> Any:
    """Observe what can change within a level, lanes last; for kinds without constant features, everything."""
    if kind == ObservationType.SYMBOLIC_FLAT:
        return state_features(level, state)
    return OF_LEVEL_AND_STATE[kind](replace(level, state=state), state)


def join(
    kind: ObservationType,
    size: Size,
    constant: Float[np.ndarray, "level feature"],
    changing: Any,
    row_level: Int[np.ndarray, " row"],
) -> Any:
    """Join what is constant and what changes into whole observations, numpy arrays [row, ...].

    Args:
        kind: type of the observation.
        size: size of the levels.
        constant: `constant_features` of the levels.
        changing: `changing_features` of the states, [row, ...].
        row_level: the level of each state.
    """
    if kind == ObservationType.SYMBOLIC_FLAT:
        return join_features(size, constant, changing, row_level)
    return changing


def observe(
    kind: ObservationType, level: Level, state: State, constant: Float[Array, "feature lane"] | None = None
) -> Any:
    """Observe a state in each lane, lanes last.

    Args:
        kind: what to return.
        level: each lane's level; of its `state`, only the pose of the scenery is read, and nothing with `constant`.
        state: each lane's world.
        constant: `constant_features(kind, level)`, if the caller has computed them, as once per rollout.
    """
    if kind == ObservationType.SYMBOLIC_FLAT:
        return symbolic_flat(level, state, constant)
    return changing_features(kind, level, state)
