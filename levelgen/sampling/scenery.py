"""The empty world: floor, left wall, right wall and ceiling, and no bodies yet.

Positions and vertices are those of Jax2D 1.0.1 (`jax2d.engine.create_empty_sim`), the skewed ceiling included.
Each polygon of the scenery is deep enough to stand for a half-plane.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from levelgen.level import HALF_WORLD, WORLD_SIDE, Level
from physics.pairs import pairs_of
from physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, Size, initial_state

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
    """Levels with the scenery only; every other row is free and holds zeros, as in the reference."""
    bodies, joints, thrusters = size.bodies, size.joints, size.thrusters

    def full(*shape: int, value: float = 0.0) -> Array:
        return jnp.full((*shape, lanes), value, jnp.float32)

    def whole(*shape: int, value: int = 0) -> Array:
        return jnp.full((*shape, lanes), value, jnp.int32)

    def no(*shape: int) -> Array:
        return jnp.zeros((*shape, lanes), bool)

    model = Model(
        gravity=_in_lanes(np.array(GRAVITY), lanes),
        active=_in_lanes(np.arange(bodies) < FIXED_POLYGONS, lanes),
        inverse_mass=full(bodies),
        inverse_inertia=full(bodies),
        friction=full(bodies, value=1.0),
        restitution=full(bodies),
        collision_mode=_in_lanes(np.where(np.arange(bodies) < FIXED_POLYGONS, MEETS_ALL, NORMAL), lanes),
        collides=_in_lanes(~np.eye(bodies, dtype=bool), lanes),
        vertices=_in_lanes(_padded(VERTICES, size.polygons), lanes),
        n_vertices=whole(size.polygons, value=MAX_VERTICES),
        radius=full(size.circles),
        joint_active=no(joints),
        joint_a=whole(joints),
        joint_b=whole(joints),
        joint_anchor_a=full(joints, 2),
        joint_anchor_b=full(joints, 2),
        joint_fixed=no(joints),
        joint_rotation=full(joints),
        joint_limited=no(joints),
        joint_min=full(joints),
        joint_max=full(joints),
        motor_on=no(joints),
        motor_speed=full(joints),
        motor_power=full(joints),
        thruster_active=no(thrusters),
        thruster_body=whole(thrusters),
        thruster_position=full(thrusters, 2),
        thruster_rotation=full(thrusters),
        thruster_power=full(thrusters),
    )
    state = initial_state(
        position=_in_lanes(_padded(POSITION, bodies), lanes),
        rotation=full(bodies),
        velocity=full(bodies, 2),
        angular_velocity=full(bodies),
        contacts=pairs_of(size).contacts,
        joints=joints,
    )
    return Level(
        model=model,
        state=state,
        role=whole(bodies),
        density=full(bodies, value=1.0),
        motor_binding=whole(joints),
        motor_auto=no(joints),
        thruster_binding=whole(thrusters),
    )


def _padded(values: tuple, rows: int) -> np.ndarray:
    """Zeros below the scenery's rows."""
    given = np.array(values, np.float32)
    return np.concatenate([given, np.zeros((rows - len(given), *given.shape[1:]), np.float32)])


def _in_lanes(values: np.ndarray, lanes: int) -> Array:
    """The same values in every lane, in the engine's 32-bit types."""
    kind = {"f": jnp.float32, "i": jnp.int32, "b": bool}[values.dtype.kind]
    return jnp.broadcast_to(jnp.asarray(values, kind)[..., None], (*values.shape, lanes))
