"""The empty world: floor, left wall, right wall and ceiling, without other bodies.

Positions and vertices are those of Jax2D 1.0.1 (`jax2d.engine.create_empty_sim`), the skewed ceiling included.
Each polygon of the scenery is deep enough to act as a half-plane.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from levelproof.levelgen.level import HALF_WORLD, WORLD_SIDE, Level
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Size

GRAVITY = (0.0, -9.81)  # m/s^2
FLOOR_TOP = 0.4  # m above the lower edge of the world
_OFFSET = FLOOR_TOP / 2
_DEEP = WORLD_SIDE + _OFFSET

POSITION = ((HALF_WORLD, _OFFSET - WORLD_SIDE), (0.0, 0.0), (0.0, 0.0), (HALF_WORLD, 2 * WORLD_SIDE + _OFFSET))
VERTICES = (
    ((HALF_WORLD, _DEEP), (HALF_WORLD, -_DEEP), (-HALF_WORLD, -_DEEP), (-HALF_WORLD, _DEEP)),
    ((-WORLD_SIDE, WORLD_SIDE), (0.0, WORLD_SIDE), (0.0, 0.0), (-WORLD_SIDE, 0.0)),
    ((WORLD_SIDE, WORLD_SIDE), (2 * WORLD_SIDE, WORLD_SIDE), (2 * WORLD_SIDE, 0.0), (WORLD_SIDE, 0.0)),
    ((WORLD_SIDE, _DEEP), (HALF_WORLD, -_DEEP), (-HALF_WORLD, -_DEEP), (-HALF_WORLD, _DEEP)),
)
MEETS_ALL, NORMAL = 2, 1  # collision modes of the scenery and of other bodies


def empty_level(size: Size, lanes: int) -> Level:
    """Return levels with the scenery only; every other row is free and holds the reference's blank values."""
    zeros, scenery = zeros_of(Level, size, lanes), np.arange(size.bodies) < FIXED_POLYGONS
    model = replace(
        zeros.model,
        gravity=_in_lanes(np.array(GRAVITY), lanes),
        active=_in_lanes(scenery, lanes),
        friction=jnp.ones_like(zeros.model.friction),
        collision_mode=_in_lanes(np.where(scenery, MEETS_ALL, NORMAL), lanes),
        collides=_in_lanes(~np.eye(size.bodies, dtype=bool), lanes),
        vertices=_in_lanes(_padded(VERTICES, size.polygons), lanes),
        n_vertices=jnp.full_like(zeros.model.n_vertices, MAX_VERTICES),
    )
    state = replace(zeros.state, position=_in_lanes(_padded(POSITION, size.bodies), lanes))
    return replace(zeros, model=model, state=state, density=jnp.ones_like(zeros.density))


def _padded(values: tuple, rows: int) -> np.ndarray:
    """Append rows of zeros to the scenery's values."""
    scenery = np.array(values, np.float32)
    return np.concatenate([scenery, np.zeros((rows - len(scenery), *scenery.shape[1:]), np.float32)])


def _in_lanes(values: np.ndarray, lanes: int) -> Array:
    """Broadcast values to all lanes, in the engine's 32-bit types."""
    kind = {"f": jnp.float32, "i": jnp.int32, "b": bool}[values.dtype.kind]
    return jnp.broadcast_to(jnp.asarray(values, kind)[..., None], (*values.shape, lanes))
