"""Rows of bodies, joints and thrusters exchanged at random, and which bodies may then collide.

Facts: `kinetix.environment.utils.permute_state` 3.0.2 and `jax2d.engine.calculate_collision_matrix` 1.0.1.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelgen.level import Level
from physics.types import FIXED_POLYGONS, Model, Size

BODY = ("active", "inverse_mass", "inverse_inertia", "friction", "restitution", "collision_mode")
MOTION = ("position", "rotation", "velocity", "angular_velocity")
JOINT = ("joint_active", "joint_a", "joint_b", "joint_anchor_a", "joint_anchor_b", "joint_fixed", "joint_rotation")
JOINT += ("joint_limited", "joint_min", "joint_max", "motor_on", "motor_speed", "motor_power")
THRUSTER = ("thruster_active", "thruster_body", "thruster_position", "thruster_rotation", "thruster_power")


class OrderDraws(NamedTuple):
    """One number for each row of every kind."""

    order: Float[Array, "row lane"]


class Order(NamedTuple):
    """For each row of a kind, the row its content comes from."""

    bodies: Int[Array, "body lane"]
    joints: Int[Array, "joint lane"]
    thrusters: Int[Array, "thruster lane"]


def shuffled_rows(size: Size) -> int:
    """How many rows are shuffled."""
    return sum(_rows_of_kinds(size))


def shuffle(level: Level, draws: OrderDraws) -> Level:
    """Movable polygons, circles, joints and thrusters in a random order each; the scenery stays."""
    order = draw_order(level.size, draws.order)
    row_of = jnp.argsort(order.bodies, 0)  # where each body went
    model, state, polygons = level.model, level.state, level.size.polygons
    model = replace(
        model,
        joint_a=_take(row_of, model.joint_a),
        joint_b=_take(row_of, model.joint_b),
        thruster_body=_take(row_of, model.thruster_body),
    )
    moved = {name: _take(getattr(model, name), order.bodies) for name in BODY}
    moved |= {name: _take(getattr(model, name), order.joints) for name in JOINT}
    moved |= {name: _take(getattr(model, name), order.thrusters) for name in THRUSTER}
    moved |= {name: _take(getattr(model, name), order.bodies[:polygons]) for name in ("vertices", "n_vertices")}
    model = replace(model, radius=_take(model.radius, order.bodies[polygons:] - polygons), **moved)
    return Level(
        model=replace(model, collides=separate(model)),
        state=replace(state, **{name: _take(getattr(state, name), order.bodies) for name in MOTION}),
        role=_take(level.role, order.bodies),
        density=_take(level.density, order.bodies),
        motor_binding=_take(level.motor_binding, order.joints),
        motor_auto=_take(level.motor_auto, order.joints),
        thruster_binding=_take(level.thruster_binding, order.thrusters),
    )


def draw_order(size: Size, numbers: Float[Array, "row lane"]) -> Order:
    parts, start = [], 0
    for count in _rows_of_kinds(size):
        parts.append(jnp.argsort(numbers[start : start + count], 0).astype(jnp.int32))
        start += count
    polygons, circles, joints, thrusters = parts
    scenery = jnp.broadcast_to(
        jnp.arange(FIXED_POLYGONS, dtype=jnp.int32)[:, None], (FIXED_POLYGONS, numbers.shape[-1])
    )
    return Order(jnp.concatenate([scenery, polygons + FIXED_POLYGONS, circles + size.polygons]), joints, thrusters)


def _rows_of_kinds(size: Size) -> tuple[int, int, int, int]:
    return size.polygons - FIXED_POLYGONS, size.circles, size.joints, size.thrusters


def separate(model: Model) -> Bool[Array, "body body lane"]:
    """Which bodies may collide: those that no chain of active joints holds together."""
    number = jnp.arange(model.size.bodies)[:, None]
    ends = [(index[:, None] == number) & model.joint_active[:, None] for index in (model.joint_a, model.joint_b)]
    first, second = ends[0][:, :, None], ends[1][:, None]
    joined = jnp.eye(model.size.bodies, dtype=bool)[..., None] | (first & second).any(0)
    joined |= joined.swapaxes(0, 1)
    for _ in range((model.size.joints - 1).bit_length()):  # chains of 1, 2, 4 ... joints
        joined = (joined[:, :, None] & joined[None]).any(1)
    return ~joined


def _take(x: Array, index: Int[Array, "row lane"]) -> Array:
    """x [row, ..., lane] at the rows of each lane."""
    spread = index.reshape(len(index), *[1] * (x.ndim - 2), index.shape[-1])
    return jnp.take_along_axis(x, spread, 0)
