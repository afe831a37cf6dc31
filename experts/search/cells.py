"""Cells, in which states of a level count as one: the archive keeps one state per cell."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from levelproof.experts.search.config import SearchConfig
from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.proofs import driven
from levelproof.physics.types import FIXED_POLYGONS, State

TURN = 2 * np.pi
FARTHEST = 1e6  # cells from the origin


def features(level: Level, state: State, config: SearchConfig) -> Float[Array, "lane feature"]:
    """Return features that tell states apart, in metres: positions of bodies, and rotations times radii of gyration.

    Velocities are left out: with many bodies they would fill the archive with states that differ in nothing else.
    """
    model, moving = level.model, slice(FIXED_POLYGONS, None)
    turns = (model.inverse_inertia > 0) & (model.inverse_mass > 0)
    arm = jnp.sqrt(jnp.where(turns, model.inverse_mass / jnp.where(turns, model.inverse_inertia, 1.0), 0.0))
    turned, shift = state.rotation - level.state.rotation, state.position - level.state.position
    angle = turned - TURN * jnp.round(turned / TURN)
    weight = weights(level, config)
    rows = shift[:, 0] * weight, shift[:, 1] * weight, angle * arm * weight
    return jnp.concatenate([row[moving] for row in rows]).T


def weights(level: Level, config: SearchConfig) -> Float[Array, "body lane"]:
    """Return the weight of each body in the features; 0 for bodies that cannot move."""
    goal = (level.role == Role.GREEN) | (level.role == Role.BLUE)
    moves = level.model.active & (level.model.inverse_mass + level.model.inverse_inertia > 0)
    return jnp.where(moves, jnp.where(driven(level) & ~goal, config.driven_weight, 1.0), 0.0)


def cell_key(feature: Float[Array, "entry feature"], width: Float[Array, ""]) -> UInt32[Array, " entry"]:
    """Hash the cell of each state to 32 bits; among so few cells, collisions are negligible."""
    cell = jnp.round(jnp.clip(feature / width, -FARTHEST, FARTHEST)).astype(jnp.int32).astype(jnp.uint32)
    factor = np.random.default_rng(0).integers(2**31, size=cell.shape[-1], dtype=np.uint32) * 2 + 1
    mixed = cell * factor
    mixed = (mixed ^ (mixed >> 15)) * np.uint32(2246822519)
    total = mixed.sum(-1, dtype=jnp.uint32)
    total = (total ^ (total >> 13)) * np.uint32(3266489917)
    return total ^ (total >> 16)
