"""A level as tables of entities, each seen relative to the nearest green, blue and red body.

An entity's features are its rows of the symbolic-flat view, those of the bodies that it is fixed to, gravity, and for
each of the three roles where the nearest such body is and how it moves, in the world's frame and in the entity's own.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, Level, Role
from levelproof.levelgen.task.observe.flat import (
    GRAVITY_UNIT,
    LIMIT,
    body_rows,
    joint_rows,
    polygon_rows,
    thruster_rows,
)
from levelproof.physics.types import FIXED_POLYGONS, State

GOALS = (Role.GREEN, Role.BLUE, Role.RED)


class EntityTables(NamedTuple):
    """The entities of each kind: polygons (the floor first, without walls and ceiling), circles, joints, thrusters."""

    features: tuple[Float[Array, "feature entity lane"], ...]
    active: Bool[Array, "token lane"]  # of all kinds, in their order
    linked: Bool[Array, "token token lane"]  # a body and what is fixed to it, both ways
    motors: Float[Array, "joint entry lane"]  # 1 where an active, free joint obeys the entry, else 0
    thrusts: Float[Array, "thruster entry lane"]


class Placed(NamedTuple):
    """Where entities are and how they move; lanes last."""

    position: Float[Array, "entity 2 lane"]  # m
    velocity: Float[Array, "entity 2 lane"]  # m/s
    angle: Float[Array, "entity lane"]  # rad, of the entity's own frame


def entity_tables(level: Level, state: State) -> EntityTables:
    """Observe levels [..., lane] in states [..., lane]; inactive entities have features, too."""
    level = replace(level, state=jax.tree.map(jnp.nan_to_num, state))
    model, size = level.model, level.size
    bodies = Placed(level.state.position, level.state.velocity, level.state.rotation)
    kept = [0, *range(FIXED_POLYGONS, size.polygons)]
    polygons, circles = np.array(kept), np.arange(size.polygons, size.bodies)
    of_body = _stacked(body_rows(level, slice(None)))
    shape = _stacked(polygon_rows(model, slice(0, size.polygons)))
    radius = _stacked([model.radius, jnp.ones_like(model.radius)])
    a, b, hull = (_one_hot(x, size.bodies) for x in (model.joint_a, model.joint_b, model.thruster_body))
    hinges = _fixed(bodies, a, model.joint_anchor_a, 0.0)
    nozzles = _fixed(bodies, hull, model.thruster_position, model.thruster_rotation)
    tables = (
        [of_body[polygons], shape[polygons], _relative(level, _at(bodies, polygons))],
        [of_body[circles], radius, _relative(level, _at(bodies, circles))],
        [_stacked(joint_rows(level)), _rows_of(a, of_body), _rows_of(b, of_body), _relative(level, hinges)],
        [_stacked(thruster_rows(level)), _rows_of(hull, of_body), _relative(level, nozzles)],
    )
    free, bound = model.joint_active & ~model.joint_fixed, level.motor_binding
    return EntityTables(
        tuple(_finished(table, model.gravity[1] / GRAVITY_UNIT) for table in tables),
        jnp.concatenate([model.active[np.r_[polygons, circles]], model.joint_active, model.thruster_active]),
        _links(np.r_[polygons, circles], a + b, hull),
        free[:, None] * _one_hot(bound, MOTOR_BINDINGS),
        model.thruster_active[:, None] * _one_hot(level.thruster_binding, THRUSTER_BINDINGS),
    )


def _relative(level: Level, entities: Placed) -> Float[Array, "entity column lane"]:
    """Return the columns that say where the nearest active body of each goal role is, seen from each entity."""
    cos, sin = jnp.cos(entities.angle), jnp.sin(entities.angle)
    columns = [cos, sin, *_in_frame(entities.velocity, cos, sin)]
    for role in GOALS:
        candidate = (level.role == role) & level.model.active
        to, moves = _nearest(level.state, candidate, entities.position)
        relative = (moves - entities.velocity) * candidate.any(0)
        distance = jnp.sqrt(jnp.square(to).sum(1))
        columns += [candidate.any(0) & jnp.ones_like(distance, bool), distance, to[:, 0], to[:, 1]]
        columns += [*_in_frame(to, cos, sin), *_in_frame(relative, cos, sin)]
    return _stacked(columns)


def _nearest(
    state: State, candidate: Bool[Array, "body lane"], at: Float[Array, "entity 2 lane"]
) -> tuple[Float[Array, "entity 2 lane"], Float[Array, "entity 2 lane"]]:
    """Return where the nearest candidate is, seen from each point, and its velocity; zeros if there is none.

    Body after body, because XLA's argmin over all bodies is slow on CPUs.
    """

    def closer(body: Array, found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        offset = state.position[body] - at
        distance = jnp.where(candidate[body], jnp.square(offset).sum(1), jnp.inf)
        takes = distance < found[0]
        select = lambda new, old: jnp.where(takes[:, None], new, old)
        return jnp.minimum(distance, found[0]), select(offset, found[1]), select(state.velocity[body], found[2])

    nothing = jnp.full((len(at), at.shape[-1]), jnp.inf), jnp.zeros_like(at), jnp.zeros_like(at)
    _, to, moves = jax.lax.fori_loop(0, len(candidate), closer, nothing)
    return to, moves


def _in_frame(xy: Float[Array, "entity 2 lane"], cos: Array, sin: Array) -> list[Array]:
    return [cos * xy[:, 0] + sin * xy[:, 1], cos * xy[:, 1] - sin * xy[:, 0]]


def _fixed(bodies: Placed, at: Float[Array, "entity body lane"], local: Array, turned: Array | float) -> Placed:
    """Place what is fixed to bodies, at `local` in a body's frame and turned by `turned` rad."""
    position, velocity = (_rows_of(at, x) for x in bodies[:2])
    angle = (at * bodies.angle).sum(1)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    arm = jnp.stack([cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]], 1)
    return Placed(position + arm, velocity, angle + turned)


def _links(
    kept: np.ndarray, ends: Float[Array, "joint body lane"], hull: Float[Array, "thruster body lane"]
) -> Bool[Array, "token token lane"]:
    fixed = jnp.concatenate([ends, hull])[:, kept] > 0  # [actuator, kept body, lane]
    count, bodies = fixed.shape[0], len(kept)
    above = jnp.concatenate([jnp.zeros((bodies, bodies, fixed.shape[-1]), bool), fixed.swapaxes(0, 1)], 1)
    below = jnp.concatenate([fixed, jnp.zeros((count, count, fixed.shape[-1]), bool)], 1)
    return jnp.concatenate([above, below])


def _at(bodies: Placed, index: np.ndarray) -> Placed:
    return Placed(*(x[index] for x in bodies))


def _rows_of(at: Float[Array, "entity body lane"], rows: Float[Array, "body row lane"]) -> Array:
    # einsum would multiply a tiny matrix in each lane
    return sum((at[:, body, None] * rows[body] for body in range(len(rows))), jnp.zeros(()))


def _one_hot(index: Array, count: int) -> Float[Array, "entity count lane"]:
    return jax.nn.one_hot(index, count, dtype=jnp.float32, axis=1)


def _stacked(rows: list[Array]) -> Float[Array, "entity row lane"]:
    return jnp.stack(jnp.broadcast_arrays(*(row.astype(jnp.float32) for row in rows)), 1)


def _finished(parts: list[Array], gravity: Float[Array, " lane"]) -> Float[Array, "feature entity lane"]:
    columns = [*parts, jnp.broadcast_to(gravity, (parts[0].shape[0], 1, gravity.shape[-1]))]
    return jnp.clip(jnp.nan_to_num(jnp.concatenate(columns, 1)), -LIMIT, LIMIT).swapaxes(0, 1)
