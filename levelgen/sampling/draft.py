"""A level while the sampler makes it: references to a block of lanes.

Bodies, joints and thrusters fill their rows in order, so the number of used rows is the next free row; it differs
between lanes. `LevelRows` holds what the sampler decides, `Notes` what later decisions need to know about bodies.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.sampling.overlap import WorldPolygon
from levelproof.levelgen.sampling.scenery import POSITION, VERTICES
from levelproof.physics.lanes import NOBODY, Ref, Scalar, each
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Size
from levelproof.physics.vector import Vec, unvec


class LevelRows(NamedTuple):
    """What the sampler decides: fields named and shaped as in Level, Model and State, whose other fields are blank."""

    role: Int[Ref, "body lane"]
    active: Bool[Ref, "body lane"]
    inverse_mass: Float[Ref, "body lane"]
    inverse_inertia: Float[Ref, "body lane"]
    position: Float[Ref, "body 2 lane"]
    rotation: Float[Ref, "body lane"]
    vertices: Float[Ref, "polygon vertex 2 lane"]
    radius: Float[Ref, "circle lane"]
    joint_active: Bool[Ref, "joint lane"]
    joint_a: Int[Ref, "joint lane"]
    joint_b: Int[Ref, "joint lane"]
    joint_anchor_a: Float[Ref, "joint 2 lane"]
    joint_anchor_b: Float[Ref, "joint 2 lane"]
    joint_fixed: Bool[Ref, "joint lane"]
    joint_rotation: Float[Ref, "joint lane"]
    joint_limited: Bool[Ref, "joint lane"]
    joint_min: Float[Ref, "joint lane"]
    joint_max: Float[Ref, "joint lane"]
    motor_on: Bool[Ref, "joint lane"]
    motor_speed: Float[Ref, "joint lane"]
    motor_power: Float[Ref, "joint lane"]
    motor_binding: Int[Ref, "joint lane"]
    thruster_active: Bool[Ref, "thruster lane"]
    thruster_body: Int[Ref, "thruster lane"]
    thruster_position: Float[Ref, "thruster 2 lane"]
    thruster_rotation: Float[Ref, "thruster lane"]
    thruster_power: Float[Ref, "thruster lane"]
    thruster_binding: Int[Ref, "thruster lane"]


class Used(NamedTuple):
    """How many rows of each kind are used, how many joints are revolute, and which roles exist."""

    polygons: Int[Ref, "lane"]
    circles: Int[Ref, "lane"]
    joints: Int[Ref, "lane"]
    revolute: Int[Ref, "lane"]
    thrusters: Int[Ref, "lane"]
    roles: Bool[Ref, "4 lane"]  # whether a body has the role


class Notes(NamedTuple):
    """What later decisions need to know about the bodies so far."""

    turn: Int[Ref, "body lane"]  # turn at which a body was added; NOBODY for the scenery
    group: Int[Ref, "body lane"]  # equal for bodies that a chain of joints holds together
    joints: Float[Ref, "body lane"]  # ends of joints at the body
    cos_sin: Float[Ref, "body 2 lane"]  # of the rotation
    low: Float[Ref, "body 2 lane"]  # lower left corner of a polygon in its own frame; zero for circles
    high: Float[Ref, "body 2 lane"]  # upper right corner
    reach: Float[Ref, "body lane"]  # a circle's radius; zero for polygons
    corner: Float[Ref, "polygon 2 vertex lane"]  # in the world, as `overlap.WorldPolygon`
    along: Float[Ref, "polygon 2 vertex lane"]
    outward: Float[Ref, "polygon 2 vertex lane"]
    length: Float[Ref, "polygon vertex lane"]
    upper: Float[Ref, "body lane"]  # cumulative weights of a choice among bodies


class Draft(NamedTuple):
    """References to a block of levels in the making."""

    rows: LevelRows
    used: Used
    notes: Notes

    @property
    def size(self) -> Size:
        """Capacity of the levels."""
        rows = self.rows
        return Size(rows.vertices.shape[0], rows.radius.shape[0], rows.joint_a.shape[0], rows.thruster_body.shape[0])


class Body(NamedTuple):
    """One body of each lane, [lane]; zeros where there is none."""

    role: Int[Array, " lane"]
    inverse_mass: Float[Array, " lane"]
    position: Vec
    cos: Float[Array, " lane"]
    sin: Float[Array, " lane"]
    low: Vec
    high: Vec
    reach: Float[Array, " lane"]


def read_body(draft: Draft, i: Scalar) -> Body:
    """Read row i."""
    rows, notes = draft.rows, draft.notes
    pair = lambda ref: Vec(ref[i, 0], ref[i, 1])
    return Body(
        rows.role[i],
        rows.inverse_mass[i],
        pair(rows.position),
        *pair(notes.cos_sin),
        pair(notes.low),
        pair(notes.high),
        notes.reach[i],
    )


def read_outline(draft: Draft, i: Scalar) -> WorldPolygon:
    """Read the outline of polygon i, in the world's frame."""
    notes = draft.notes
    pair = lambda ref: Vec(ref[i, 0], ref[i, 1])
    return WorldPolygon(pair(notes.corner), pair(notes.along), pair(notes.outward), notes.length[i])


def outline_changes(draft: Draft, outline: WorldPolygon) -> list[tuple[Ref, Array]]:
    """Return (reference, new row) for each part of an outline."""
    notes, pair = draft.notes, lambda v: jnp.stack([v.x, v.y])
    return [
        (notes.corner, pair(outline.corner)),
        (notes.along, pair(outline.along)),
        (notes.outward, pair(outline.outward)),
        (notes.length, outline.length),
    ]


class SceneryTable(NamedTuple):
    """The scenery as lookup tables of the kernel, without lanes."""

    position: Float[Ref, "4 2"]
    vertices: Float[Ref, "4 4 2"]


SCENERY = SceneryTable(np.array(POSITION, np.float32), np.array(VERTICES, np.float32))


def clear(draft: Draft, scenery: SceneryTable) -> None:
    """Reset the draft to a world that contains only the scenery."""
    *counts, roles = draft.used
    for ref in (*draft.rows, *draft.notes, roles):
        _zero(ref)
    for count, ref in zip((FIXED_POLYGONS, 0, 0, 0, 0), counts, strict=True):
        ref[...] = jnp.full_like(ref[...], count)
    each(draft.size.bodies, lambda i: _separate(draft, i))
    each(FIXED_POLYGONS, lambda i: _add_scenery(draft, i, scenery))


def _zero(ref: Ref) -> None:
    def one(i):
        ref[i] = jnp.zeros_like(ref[i])

    each(ref.shape[0], one)


def _separate(draft: Draft, i: Scalar) -> None:
    """Put body i in a group of its own."""
    draft.notes.group[i] = jnp.zeros_like(draft.notes.group[i]) + i
    draft.notes.turn[i] = jnp.full_like(draft.notes.turn[i], NOBODY)


def _add_scenery(draft: Draft, i: Scalar, scenery: SceneryTable) -> None:
    rows, notes = draft.rows, draft.notes
    one = jnp.ones_like(rows.rotation[i])
    rows.active[i] = one > 0
    corner = Vec(*(jnp.stack([scenery.vertices[i, k, axis] * one for k in range(MAX_VERTICES)]) for axis in range(2)))
    position = Vec(*(scenery.position[i, axis] * one for axis in range(2)))
    rows.vertices[i] = unvec(corner)
    rows.position[i] = unvec(position)
    notes.cos_sin[i] = jnp.stack([one, one * 0])
    notes.low[i] = unvec(corner.map(lambda x: x.min(0)))
    notes.high[i] = unvec(corner.map(lambda x: x.max(0)))
    for ref, row in outline_changes(draft, WorldPolygon.of(corner + position)):
        ref[i] = row
