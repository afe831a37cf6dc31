"""A body that the sampler may add: its random numbers, its shape, its joint, and how it enters a level.

Lanes are last; choices are one-hot instead of indices. Follows `kinetix.environment.ued` 3.0.2; numbers are fields of
`Distribution`. A proposal is only the new body and joint, where the reference's mutators return a whole new level.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draws import at, between, first_free, pick, put
from levelproof.physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from levelproof.physics.types import MAX_VERTICES
from levelproof.physics.vector import Vec, unvec, vec, where

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

    target: Bool[Array, "body lane"]
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


def corners(half: Vec) -> Float[Array, "vertex 2 lane"]:
    """Return a rectangle's corners in its own frame."""
    return jnp.asarray(CORNERS)[:, :, None] * unvec(half)[None]


def corners_in_world(p: Proposal) -> Float[Array, "vertex 2 lane"]:
    """Return the corners of the body as if it were a polygon."""
    return unvec(turned(vec(corners(p.shape.half)), p.rotation) + p.position)


def shape_mass(shape: BodyShape) -> tuple[Lane, Lane]:
    """Return mass, kg, and inertia, kg m^2; all bodies have a density of 1 kg/m^2."""
    vertices, four = corners(shape.half)[None], jnp.full((1, *shape.radius.shape), MAX_VERTICES)
    mass = jnp.where(shape.is_polygon, polygon_area(vertices, four)[0], circle_area(shape.radius))
    inertia = jnp.where(shape.is_polygon, polygon_inertia(vertices, four)[0], circle_inertia(shape.radius))
    return mass, inertia


def draw_role(level: Level, u: Lane, red_allowed: Flag | bool, dist: Distribution) -> Int[Array, " lane"]:
    """Draw a role: green and blue first, then plain or red, and at most one red (util.get_role)."""
    present = [(level.model.active & (level.role == role)).any(0) for role in (Role.GREEN, Role.BLUE, Role.RED)]
    complete = present[0] & present[1]
    red = jnp.where(complete & ~present[2] & red_allowed, dist.red_weight, 0.0)
    return pick(jnp.stack([1.0 * complete, 1.0 * ~present[0], 1.0 * ~present[1], red]), u)


def insert(level: Level, p: Proposal) -> Level:
    """Insert the proposed body and its joint in the first free rows of a level."""
    polygons, model, state = level.size.polygons, level.model, level.state
    polygon = first_free(model.active[:polygons]) & p.shape.is_polygon & p.possible
    circle = first_free(model.active[polygons:]) & ~p.shape.is_polygon & p.possible
    body = jnp.concatenate([polygon, circle])
    mass, inertia = shape_mass(p.shape)
    model = replace(
        model,
        active=model.active | body,
        inverse_mass=put(model.inverse_mass, body, jnp.where(p.fixed, 0.0, inverse(mass))),
        inverse_inertia=put(model.inverse_inertia, body, jnp.where(p.fixed, 0.0, inverse(inertia))),
        vertices=put(model.vertices, polygon, corners(p.shape.half)),
        radius=put(model.radius, circle, p.shape.radius),
    )
    state = replace(
        state,
        position=put(state.position, body, unvec(p.position)),
        rotation=put(state.rotation, body, p.rotation),
    )
    level = replace(level, model=model, state=state, role=put(level.role, body, p.role))
    return _insert_joint(level, p, body) if level.size.joints else level


def _insert_joint(level: Level, p: Proposal, body: Bool[Array, "body lane"]) -> Level:
    """Insert the proposal's joint; its first body is the one with the smaller index, as in the reference."""
    model, joint = level.model, p.joint
    row = first_free(model.joint_active) & p.joined
    indices = jnp.arange(level.size.bodies)[:, None]
    own, target = at(indices, body), at(indices, joint.target)
    target_first = target < own
    first, second = (
        where(target_first, joint.target_anchor, joint.anchor),
        where(target_first, joint.anchor, joint.target_anchor),
    )
    rotation = p.rotation - at(level.state.rotation, joint.target)
    rotation = jnp.where(joint.joint_fixed, jnp.where(target_first, rotation, -rotation), 0.0)
    copied = {name: put(vars(model)[name], row, x) for name, x in joint._asdict().items() if name in vars(model)}
    model = replace(
        model,
        **copied,
        joint_active=model.joint_active | row,
        joint_a=put(model.joint_a, row, jnp.minimum(own, target)),
        joint_b=put(model.joint_b, row, jnp.maximum(own, target)),
        joint_anchor_a=put(model.joint_anchor_a, row, unvec(first)),
        joint_anchor_b=put(model.joint_anchor_b, row, unvec(second)),
        joint_rotation=put(model.joint_rotation, row, rotation),
    )
    return replace(level, model=model, motor_binding=put(level.motor_binding, row, joint.motor_binding))


def turned(v: Vec, angle: Lane) -> Vec:
    return v.rotate(jnp.cos(angle), jnp.sin(angle))
