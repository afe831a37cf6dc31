"""A body that the sampler may add: its random numbers, its shape, its joint, and how it enters a level.

Follows `kinetix.environment.ued` 3.0.2; numbers are fields of `Distribution`. A proposal is only the new body and its
joint, whereas the reference's mutators return a whole new level.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draft import Draft, outline_changes, read_body, read_outline
from levelproof.levelgen.sampling.draws import between, pick
from levelproof.levelgen.sampling.overlap import WorldCircle, WorldPolygon, discs_touch, polygon_contacts, touch
from levelproof.physics.lanes import NOBODY, Scalar, gather, put, scatter_add
from levelproof.physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from levelproof.physics.trigonometry import cos_sin
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES
from levelproof.physics.vector import Vec, unvec, where

CORNERS = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], np.float32)  # of a rectangle, clockwise
Lane = Float[Array, " lane"]
Flag = Bool[Array, " lane"]


class BodyDraws(NamedTuple):
    """Random numbers of one proposal, each [lane]."""

    is_polygon: Lane
    half_x: Lane
    half_y: Lane
    long: Lane
    long_x: Lane
    radius: Lane
    rotation: Lane
    role: Lane
    # free bodies only
    x: Lane
    y: Lane
    opposite: Lane
    fixed: Lane
    lowered: Lane
    # connected bodies only
    target_is_polygon: Lane
    target: Lane
    anchor_x: Lane
    anchor_y: Lane
    target_anchor_x: Lane
    target_anchor_y: Lane
    joint_fixed: Lane
    motor: Lane
    motor_binding: Lane
    motor_speed: Lane
    motor_power: Lane
    limited: Lane
    limit_min: Lane
    limit_max: Lane


class BodyShape(NamedTuple):
    """A rectangle or a circle; the fields of the other kind have their minimum."""

    is_polygon: Flag
    half: Vec  # m, half width and half height
    radius: Lane  # m


class Joint(NamedTuple):
    """A joint from the proposed body to its target. Fields named as in Model hold that field's value."""

    target: Int[Array, " lane"]  # row of a body
    anchor: Vec  # in the frame of the proposed body
    target_anchor: Vec
    joint_fixed: Flag
    joint_limited: Flag
    joint_min: Lane
    joint_max: Lane
    motor_on: Flag
    motor_speed: Lane
    motor_power: Lane
    motor_binding: Int[Array, " lane"]


class Proposal(NamedTuple):
    """A body to add if `possible`, with a joint if `joined`."""

    possible: Flag
    shape: BodyShape
    position: Vec
    rotation: Lane
    role: Int[Array, " lane"]
    fixed: Flag
    joined: Flag
    joint: Joint
    hidden: Flag  # at every angle of the joint, one of the bodies may lie within the other


def draw_shape(d: BodyDraws, is_polygon: Flag, size: Lane | float, dist: Distribution) -> BodyShape:
    """Draw uniform half sides or a radius; some rectangles get one longer side (util.sample_dimensions)."""
    longest = size / 2 / math.sqrt(2)
    half = [
        jnp.where(is_polygon, between(u, dist.min_half_side, longest), dist.min_half_side) for u in (d.half_x, d.half_y)
    ]
    long, long_x = d.long < dist.long_side_chance, d.long_x < 0.5
    stretch = [jnp.where(long & side, dist.long_side_factor, 1.0) for side in (long_x, ~long_x)]
    radius = between(d.radius, dist.min_radius, size / 2 * dist.circle_size_factor)
    return BodyShape(
        is_polygon, Vec(half[0] * stretch[0], half[1] * stretch[1]), jnp.where(is_polygon, dist.min_radius, radius)
    )


def corners(half: Vec) -> Vec:
    """Return a rectangle's corners in its own frame, components [corner, lane]."""
    return Vec(*(jnp.stack([sign * x for sign in signs.tolist()]) for x, signs in zip(half, CORNERS.T, strict=True)))


def outline_of(p: Proposal) -> WorldPolygon:
    """Return the outline of the body as if it were a polygon."""
    return WorldPolygon.of(corners(p.shape.half).rotate(*cos_sin(p.rotation)) + p.position)


def shape_mass(shape: BodyShape) -> tuple[Lane, Lane]:
    """Return mass, kg, and inertia, kg m^2; all bodies have a density of 1 kg/m^2."""
    vertices = unvec(corners(shape.half))[None]
    four = jnp.full((1, *shape.radius.shape), MAX_VERTICES)
    mass = jnp.where(shape.is_polygon, polygon_area(vertices, four)[0], circle_area(shape.radius))
    inertia = jnp.where(shape.is_polygon, polygon_inertia(vertices, four)[0], circle_inertia(shape.radius))
    return mass, inertia


def draw_role(draft: Draft, u: Lane, red_allowed: Flag | bool, dist: Distribution) -> Int[Array, " lane"]:
    """Draw a role: green and blue first, then plain or red, and at most one red (util.get_role)."""
    green, blue, red = (draft.used.roles[role] for role in (Role.GREEN, Role.BLUE, Role.RED))
    as_red = jnp.where(green & blue & ~red & red_allowed, dist.red_weight, 0.0)
    return pick([1.0 * (green & blue), 1.0 * ~green, 1.0 * ~blue, as_red], u)


def count_contacts(draft: Draft, p: Proposal) -> Int[Array, " lane"]:
    """Count the proposed body's contacts with the bodies of the draft."""
    polygons, circles = draft.size[:2]
    outline, disc, is_polygon = outline_of(p), WorldCircle(p.position, p.shape.radius), p.shape.is_polygon

    def with_polygon(i, count):
        other = read_outline(draft, i)
        contacts = jnp.where(is_polygon, polygon_contacts(other, outline), touch(other, disc))
        return count + jnp.where(i < draft.used.polygons[...], contacts, 0)

    def with_circle(i, count):
        body = read_body(draft, polygons + i)
        other = WorldCircle(body.position, body.reach)
        touching = jnp.where(is_polygon, touch(outline, other), discs_touch(other, disc))
        return count + (touching & (i < draft.used.circles[...]))

    none = jnp.zeros_like(p.role)
    count = jax.lax.fori_loop(0, polygons, with_polygon, none)
    return jax.lax.fori_loop(0, circles, with_circle, count) if circles else count


def insert(draft: Draft, p: Proposal, turn: Scalar) -> None:
    """Insert the proposed body and its joint into the next free rows."""
    rows, used, notes, polygons = draft.rows, draft.used, draft.notes, draft.size.polygons
    polygon, circle = p.possible & p.shape.is_polygon, p.possible & ~p.shape.is_polygon
    body = jnp.where(polygon, used.polygons[...], jnp.where(circle, polygons + used.circles[...], NOBODY))
    joins = p.joined & p.possible
    group = gather(polygons + draft.size.circles, lambda i: notes.group[i], jnp.where(joins, p.joint.target, body))
    (mass, inertia), local, radius = shape_mass(p.shape), corners(p.shape.half), p.shape.radius
    half = unvec(p.shape.half)
    put(
        body,
        (rows.active, True),
        (rows.role, p.role),
        (rows.inverse_mass, jnp.where(p.fixed, 0.0, inverse(mass))),
        (rows.inverse_inertia, jnp.where(p.fixed, 0.0, inverse(inertia))),
        (rows.position, unvec(p.position)),
        (rows.rotation, p.rotation),
        (notes.turn, turn),
        (notes.group, group),
        (notes.cos_sin, jnp.stack(cos_sin(p.rotation))),
        (notes.low, jnp.where(polygon, -half, 0.0)),
        (notes.high, jnp.where(polygon, half, 0.0)),
        (notes.reach, jnp.where(polygon, 0.0, radius)),
        first=FIXED_POLYGONS,
    )
    put(body, (rows.vertices, unvec(local)), *outline_changes(draft, outline_of(p)), first=FIXED_POLYGONS)
    if draft.size.circles:
        put(body - polygons, (rows.radius, radius))
    for role in range(used.roles.shape[0]):
        used.roles[role] |= p.possible & (p.role == role)
    if draft.size.joints:
        _insert_joint(draft, p, body, joins)
    used.polygons[...] += polygon
    used.circles[...] += circle


def _insert_joint(draft: Draft, p: Proposal, body: Int[Array, " lane"], joins: Flag) -> None:
    """Insert the proposal's joint; its first body is the one with the smaller index, as in the reference."""
    rows, used, joint = draft.rows, draft.used, p.joint
    target_first = joint.target < body
    first, second = (
        where(target_first, joint.target_anchor, joint.anchor),
        where(target_first, joint.anchor, joint.target_anchor),
    )
    turned = p.rotation - gather(draft.size.bodies, lambda i: rows.rotation[i], joint.target)
    resting = jnp.where(joint.joint_fixed, jnp.where(target_first, turned, -turned), 0.0)
    copied = [(getattr(rows, name), x) for name, x in joint._asdict().items() if name in rows._fields]
    put(
        jnp.where(joins, used.joints[...], NOBODY),
        (rows.joint_active, True),
        (rows.joint_a, jnp.minimum(body, joint.target)),
        (rows.joint_b, jnp.maximum(body, joint.target)),
        (rows.joint_anchor_a, unvec(first)),
        (rows.joint_anchor_b, unvec(second)),
        (rows.joint_rotation, resting),
        *copied,
    )
    ends = [jnp.where(joins, end, NOBODY) for end in (body, joint.target)]
    scatter_add(draft.notes.joints, *((end, jnp.ones_like(p.rotation)) for end in ends))
    used.joints[...] += joins
    used.revolute[...] += joins & ~joint.joint_fixed
