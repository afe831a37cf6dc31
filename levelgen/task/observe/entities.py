"""Observations with one row per entity: the padded symbolic one, and sets of entities with masks for attention.

An entity is a body, joint or thruster. Lanes are last, as everywhere. An entity's columns are its features in the flat
observation (`levelgen.task.observe.flat`).
Facts: `kinetix.render.renderer_symbolic_flat` and `renderer_symbolic_entity` 3.0.2.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.flat import (
    GRAVITY_UNIT,
    body_rows,
    joint_rows,
    polygon_rows,
    symbolic_flat,
    tables_of,
    thruster_rows,
)
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import Size, State

KINDS = 4  # polygons, circles, joints, thrusters


def padded_shape(size: Size) -> tuple[int, int]:
    """Return the entity and column counts of `symbolic_padded`."""
    tables = tables_of(size)
    return sum(count for count, _ in tables), max(rows for _, rows in tables) + KINDS + 1


def symbolic_padded(level: Level, state: State) -> Float[Array, "entity column lane"]:
    """Observe polygons (without walls and ceiling), circles, joints and thrusters, a row each.

    Columns: the entity's features, zeros as padding, its kind one-hot, gravity.
    """
    size, flat = level.size, symbolic_flat(level, state)
    (count_all, columns), lanes = padded_shape(size), flat.shape[-1]
    rows, start = [], 0
    for kind, (count, width) in enumerate(tables_of(size)):
        own = flat[start : start + count * width].reshape(count, width, lanes)
        zeros = jnp.zeros((count, columns - KINDS - 1 - width, lanes))
        is_kind = jnp.broadcast_to(jnp.eye(KINDS)[kind][:, None], (count, KINDS, lanes))
        rows.append(jnp.concatenate([own, zeros, is_kind], axis=1))
        start += count * width
    gravity = jnp.broadcast_to(flat[-1], (count_all, 1, lanes))
    return jnp.concatenate([jnp.concatenate(rows), gravity], axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EntityObservation:
    """Sets of entities for attention. Every joint appears twice: as seen from body b, then from body a.

    Values are not clipped, and not blanked for inactive entities; the masks say which are active. Bodies are indexed
    polygons first. attention_mask[k, i, j]: active body i may attend to active body j because (0) all may, (1) they
    cannot collide, since a chain of joints holds them together, (2) a joint joins them, (3) the pair (i, j), i < j or
    a circle before a polygon, touched in the last physics step.
    """

    circles: Float[Array, "circle 19 lane"]
    polygons: Float[Array, "polygon 27 lane"]
    joints: Float[Array, "joint_end 22 lane"]
    thrusters: Float[Array, "thruster 8 lane"]
    circle_mask: Bool[Array, "circle lane"]
    polygon_mask: Bool[Array, "polygon lane"]
    joint_mask: Bool[Array, "joint_end lane"]
    thruster_mask: Bool[Array, "thruster lane"]
    attention_mask: Bool[Array, "4 body body lane"]
    joint_indexes: Int[Array, "joint_end 2 lane"]  # attending body, attended body; 0 for inactive joints
    thruster_indexes: Int[Array, "thruster lane"]  # the body that each thruster is on


def entities(level: Level, state: State) -> EntityObservation:
    """Observe the entities of a state."""
    level, size = replace(level, state=jax.tree.map(jnp.nan_to_num, state)), level.size
    model, polygons, circles = level.model, slice(0, size.polygons), slice(size.polygons, size.bodies)
    radius = [model.radius, jnp.ones_like(model.radius)]
    gravity = jnp.broadcast_to(model.gravity[1] / GRAVITY_UNIT, model.friction.shape)
    joints = [_table(joint_rows(level, seen_from_a)) for seen_from_a in (False, True)]
    index = jnp.where(model.joint_active, jnp.stack([model.joint_b, model.joint_a]), 0)  # [end, joint, lane]
    return EntityObservation(
        circles=_table([*body_rows(level, circles), *radius, gravity[circles]]),
        polygons=_table([*body_rows(level, polygons), *polygon_rows(model, polygons), gravity[polygons]]),
        joints=jnp.concatenate(joints),
        thrusters=_table(thruster_rows(level)),
        circle_mask=model.active[circles],
        polygon_mask=model.active[polygons],
        joint_mask=jnp.concatenate([model.joint_active] * 2),
        thruster_mask=model.thruster_active,
        attention_mask=_attention_mask(level, index),
        joint_indexes=jnp.concatenate([jnp.stack([index[0], index[1]], 1), jnp.stack([index[1], index[0]], 1)]),
        thruster_indexes=model.thruster_body,
    )


def _table(rows: list[Array]) -> Float[Array, "entity row lane"]:
    return jnp.stack(jnp.broadcast_arrays(*(jnp.nan_to_num(row.astype(jnp.float32)) for row in rows)), axis=1)


def _attention_mask(level: Level, joint_index: Int[Array, "2 joint lane"]) -> Bool[Array, "4 body body lane"]:
    model, bodies = level.model, level.size.bodies
    body = jnp.arange(bodies)[:, None]
    is_end = (joint_index[:, :, None] == body) & model.joint_active[:, None]  # [end, joint, body, lane]
    joined = (is_end[0][:, :, None] & is_end[1][:, None]).any(0)
    masks = [jnp.ones_like(joined), ~model.collides, joined | joined.swapaxes(0, 1), _touching(level)]
    both = model.active[:, None] & model.active[None]
    return jnp.stack(jnp.broadcast_arrays(*(mask & both for mask in masks)))


def _touching(level: Level) -> Bool[Array, "body body lane"]:
    """Return a matrix of the body pairs that touched in the last physics step."""
    pairs, active = pairs_of(level.size), level.state.contact_active
    n, kinds = len(pairs.polygon), (pairs.polygon, pairs.circle_polygon, pairs.circle)
    first, second = sum((kind.a for kind in kinds), ()), sum((kind.b for kind in kinds), ())
    row = np.full((level.size.bodies, level.size.bodies), len(first))  # the last row means "no pair"
    row[first, second] = np.arange(len(first))
    none = jnp.zeros((1, active.shape[-1]), bool)
    return jnp.concatenate([active[:n] | active[n : 2 * n], active[2 * n :], none])[row]
