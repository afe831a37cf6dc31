"""The sampler's moves: propose a free body, propose a body joined to another, put a proposal into a level, add a
thruster.

All lanes last; one-hot choices stand for indices. Facts: `kinetix.environment.ued.mutators` 3.0.2
(mutate_add_shape, mutate_add_connected_shape, mutate_add_thruster); numbers are fields of `Distribution`.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelgen.chance import at, between, choose, first_free, first_of_two, put
from levelgen.distribution import HALF_WORLD, Distribution
from levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, WORLD_SIDE, Level, Role
from levelgen.scenery import FLOOR_TOP
from physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from physics.types import FIXED_POLYGONS, MAX_VERTICES
from physics.vector import Vec, unvec, vec, where

CORNERS = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], np.float32)  # of a rectangle, clockwise
TURN = 2 * math.pi
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
    # free
    x: Lane
    y: Lane
    opposite: Lane
    fixed: Lane
    lowered: Lane
    # connected
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


class ThrusterDraws(NamedTuple):
    wanted: Lane
    body: Lane
    x: Lane
    y: Lane
    outward: Lane
    aligned: Lane
    angle: Lane
    power: Lane
    binding: Lane


class Shape(NamedTuple):
    """A rectangle or a circle; what the other kind would need is at its minimum."""

    is_polygon: Flag
    half: Vec  # m, half width and half height
    radius: Lane  # m


class Joint(NamedTuple):
    """From the proposed body to its target."""

    target: Bool[Array, "body lane"]
    anchor: Vec  # in the frame of the proposed body
    target_anchor: Vec
    fixed: Flag
    limited: Flag
    limit_min: Lane
    limit_max: Lane
    motor_on: Flag
    motor_speed: Lane
    motor_power: Lane
    motor_binding: Int[Array, " lane"]


class Proposal(NamedTuple):
    """A body to add, with a joint where `joined`; nothing where not `possible`."""

    possible: Flag
    shape: Shape
    position: Vec
    rotation: Lane
    role: Int[Array, " lane"]
    fixed: Flag
    joined: Flag
    joint: Joint
    hidden: Flag  # one of the joined bodies may lie within the other whatever the joint's angle


def draw_shape(d: BodyDraws, is_polygon: Flag, size: Lane | float, dist: Distribution) -> Shape:
    """Uniform half sides or radius; one side of some rectangles is longer (util.sample_dimensions)."""
    longest = size / 2 / math.sqrt(2)
    half = [
        jnp.where(is_polygon, between(u, dist.min_half_side, longest), dist.min_half_side) for u in (d.half_x, d.half_y)
    ]
    long, long_x = d.long < dist.long_side_chance, d.long_x < 0.5
    stretch = [jnp.where(long & side, dist.long_side_factor, 1.0) for side in (long_x, ~long_x)]
    radius = between(d.radius, dist.min_radius, size / 2 * dist.circle_size_factor)
    return Shape(
        is_polygon, Vec(half[0] * stretch[0], half[1] * stretch[1]), jnp.where(is_polygon, dist.min_radius, radius)
    )


def corners(half: Vec) -> Float[Array, "vertex 2 lane"]:
    return jnp.asarray(CORNERS)[:, :, None] * unvec(half)[None]


def corners_in_world(p: Proposal) -> Float[Array, "vertex 2 lane"]:
    """As if the body were a polygon."""
    return unvec(_turned(vec(corners(p.shape.half)), p.rotation) + p.position)


def shape_mass(shape: Shape) -> tuple[Lane, Lane]:
    """kg and kg m^2 at the density of 1 kg/m^2 that all bodies have."""
    vertices, four = corners(shape.half)[None], jnp.full((1, *shape.radius.shape), MAX_VERTICES)
    mass = jnp.where(shape.is_polygon, polygon_area(vertices, four)[0], circle_area(shape.radius))
    inertia = jnp.where(shape.is_polygon, polygon_inertia(vertices, four)[0], circle_inertia(shape.radius))
    return mass, inertia


def room(level: Level) -> tuple[Flag, Flag]:
    """Whether a polygon and a circle more would fit."""
    polygons = level.size.polygons
    return ~level.model.active[:polygons].all(0), ~level.model.active[polygons:].all(0)


def draw_role(level: Level, u: Lane, red_allowed: Flag | bool, dist: Distribution) -> Int[Array, " lane"]:
    """Green and blue come first, then plain, and at most one red (util.get_role)."""
    there = [(level.model.active & (level.role == role)).any(0) for role in (Role.GREEN, Role.BLUE, Role.RED)]
    complete = there[0] & there[1]
    red = jnp.where(complete & ~there[2] & red_allowed, dist.red_weight, 0.0)
    chosen = choose(jnp.stack([1.0 * complete, 1.0 * ~there[0], 1.0 * ~there[1], red]), u)
    return at(jnp.arange(len(Role))[:, None], chosen)


def propose_free(level: Level, d: BodyDraws, may_be_fixed: Flag, dist: Distribution) -> Proposal:
    """A body somewhere in the world, above the floor."""
    room_polygon, room_circle = room(level)
    is_polygon = first_of_two(room_polygon, room_circle, d.is_polygon)
    role = draw_role(level, d.role, True, dist)
    goal = role != Role.PLAIN
    shape = draw_shape(
        d, is_polygon, dist.max_size * jnp.where(goal & (role != Role.RED), dist.goal_size_factor, 1.0), dist
    )
    mass, _ = shape_mass(shape)
    chance = jnp.minimum(dist.fixed_chance + mass * dist.fixed_chance_per_mass, dist.max_fixed_chance)
    fixed = (d.fixed < chance) & may_be_fixed
    lowered = fixed & (d.lowered < dist.lowered_chance + jnp.where(goal, dist.goal_lowered_chance, 0.0))
    position = free_position(d, shape, role, dist)
    lower = jnp.where(lowered & (position.y >= HALF_WORLD), HALF_WORLD, 0.0)
    no = jnp.zeros_like(fixed)
    return Proposal(
        possible=room_polygon | room_circle,
        shape=shape,
        position=Vec(position.x, position.y - lower),
        rotation=d.rotation * TURN,
        role=role,
        fixed=fixed,
        joined=no,
        joint=_no_joint(level),
        hidden=no,
    )


def free_position(d: BodyDraws, shape: Shape, role: Int[Array, " lane"], dist: Distribution) -> Vec:
    """Within the world by the body's reach; green on the left and blue on the right where on opposite sides."""
    reach = jnp.maximum(jnp.maximum(shape.half.x, shape.half.y) * math.sqrt(2), shape.radius)
    opposite = d.opposite < dist.opposite_sides_chance
    low = reach + jnp.where(opposite & (role == Role.BLUE), HALF_WORLD, 0.0)
    high = WORLD_SIDE - reach - jnp.where(opposite & (role == Role.GREEN), HALF_WORLD, 0.0)
    return Vec(between(d.x, low, high), between(d.y, reach + FLOOR_TOP, WORLD_SIDE - reach))


def propose_connected(level: Level, d: BodyDraws, revolute: Flag, dist: Distribution) -> Proposal:
    """A body joined to one that is there, wherever that puts it."""
    model, polygons = level.model, level.size.polygons
    room_polygon, room_circle = room(level)
    weight = target_weights(level, dist)
    any_polygon = model.active[FIXED_POLYGONS:polygons].any(0)
    any_circle = (weight[polygons:] > 0).any(0)
    target_is_polygon = first_of_two(any_polygon, any_circle, d.target_is_polygon) | ~room_polygon
    is_polygon = first_of_two(room_polygon, room_circle, d.is_polygon) | (~target_is_polygon & room_polygon)
    shape = draw_shape(d, is_polygon, dist.max_size, dist)
    target = choose_target(level, weight, target_is_polygon, d.target)

    low, high = extent(level, target)
    anchor = where(
        is_polygon,
        Vec(between(d.anchor_x, -shape.half.x, shape.half.x), between(d.anchor_y, -shape.half.y, shape.half.y)),
        _origin(d.x),
    )
    target_anchor = where(
        target_is_polygon,
        Vec(between(d.target_anchor_x, low.x, high.x), between(d.target_anchor_y, low.y, high.y)),
        _origin(d.x),
    )
    rotation = d.rotation * TURN
    meet = vec(at(level.state.position, target)) + _turned(target_anchor, at(level.state.rotation, target))
    role = draw_role(level, d.role, at(level.role, target) == Role.PLAIN, dist)
    joint = draw_joint(level, d, target, is_polygon & target_is_polygon, revolute, dist)._replace(
        anchor=anchor, target_anchor=target_anchor
    )
    partner = Shape(target_is_polygon, (high - low).scale(0.5), at(_radius(level), target))
    possible = (room_polygon | room_circle) & model.active[FIXED_POLYGONS:].any(0) & ~model.joint_active.all(0)
    return Proposal(
        possible=possible,
        shape=shape,
        position=meet - _turned(anchor, rotation),
        rotation=rotation,
        role=role,
        fixed=jnp.zeros_like(possible),
        joined=possible,
        joint=joint,
        hidden=~both_show(shape, partner, anchor, target_anchor, dist),
    )


def target_weights(level: Level, dist: Distribution) -> Float[Array, "body lane"]:
    """How readily each body is connected to: less with each joint it has, rarely if it is fixed."""
    model, bodies = level.model, level.size.bodies
    number = jnp.arange(bodies)[:, None]
    ends = ((model.joint_a[:, None] == number) * 1.0 + (model.joint_b[:, None] == number)) * model.joint_active[:, None]
    joints = ends.sum(0)
    free = jnp.where(
        jnp.arange(bodies)[:, None] < level.size.polygons,
        jnp.maximum(1 - joints / dist.polygon_connections, 0.0),
        joints == 0,
    )
    movable = jnp.where(model.inverse_mass == 0, dist.fixed_target_weight, 1.0)
    return jnp.where(model.active & (number >= FIXED_POLYGONS), free * movable, 0.0)


def choose_target(
    level: Level, weight: Float[Array, "body lane"], is_polygon: Flag, u: Lane
) -> Bool[Array, "body lane"]:
    """A polygon (any, the scenery included, where all have their joints) or a circle without a joint."""
    polygons = level.size.polygons
    full = (weight[:polygons] > 0).any(0)
    among_polygons = jnp.where(full, weight[:polygons], level.model.active[:polygons])
    circles = weight[polygons:]
    parts = [choose(among_polygons, u) & is_polygon]
    if level.size.circles:
        parts.append(choose(circles, u) & ~is_polygon)
    return jnp.concatenate(parts)


def extent(level: Level, chosen: Bool[Array, "body lane"]) -> tuple[Vec, Vec]:
    """Lower left and upper right corner of the chosen polygon in its own frame; zero for circles."""
    vertices = level.model.vertices
    polygon = chosen[: level.size.polygons]
    return vec(at(vertices.min(1), polygon)), vec(at(vertices.max(1), polygon))


def draw_joint(
    level: Level, d: BodyDraws, target: Bool[Array, "body lane"], polygons: Flag, revolute: Flag, dist: Distribution
) -> Joint:
    """Joint and motor; `polygons` where it joins two of them. Its anchors are not set."""
    model = level.model
    enough = (model.joint_active & ~model.joint_fixed).sum(0) >= dist.min_revolute_joints
    fixed = (d.joint_fixed < dist.fixed_joint_chance) & enough & ~revolute
    turns = ~fixed
    limited = turns & polygons & (d.limited < dist.limit_chance)
    top = jnp.where(polygons, dist.max_motor_power, dist.max_wheel_power)
    return Joint(
        target=target,
        anchor=_origin(d.x),
        target_anchor=_origin(d.x),
        fixed=fixed,
        limited=limited,
        limit_min=jnp.where(limited, between(d.limit_min, -dist.max_limit, 0.0), 0.0),
        limit_max=jnp.where(limited, between(d.limit_max, 0.0, dist.max_limit), 0.0),
        motor_on=turns & (d.motor < dist.motor_chance),
        motor_speed=jnp.where(turns, between(d.motor_speed, dist.min_motor_speed, dist.max_motor_speed), 0.0),
        motor_power=jnp.where(turns, between(d.motor_power, dist.min_motor_power, top), 0.0),
        motor_binding=(d.motor_binding * MOTOR_BINDINGS).astype(jnp.int32),
    )


def both_show(new: Shape, target: Shape, anchor: Vec, target_anchor: Vec, dist: Distribution) -> Flag:
    """Whether each of two joined bodies can be seen beside the other at some angle of their joint.

    As the reference has it: where it numbers the target as the joint's first body (always but for a new polygon on
    a circle), it tests each body with the OTHER one's anchor.
    """
    exchanged = ~new.is_polygon | target.is_polygon
    new_anchor, other_anchor = where(exchanged, target_anchor, anchor), where(exchanged, anchor, target_anchor)
    margin = dist.visible_margin
    return _shows(new, target, new_anchor, other_anchor, margin) & _shows(target, new, other_anchor, new_anchor, margin)


def _shows(small: Shape, big: Shape, small_anchor: Vec, big_anchor: Vec, margin: float) -> Flag:
    """Whether `small` reaches beyond `big`: by its farthest corner, or beyond the nearest side."""
    far_x, far_y = (half + jnp.abs(p) for half, p in zip(small.half, small_anchor, strict=True))
    farthest = Vec(far_x, far_y).norm()
    reach = jnp.where(small.is_polygon, farthest, small.radius)
    side_x, side_y = (half - jnp.abs(p) for half, p in zip(big.half, big_anchor, strict=True))
    cover = jnp.where(big.is_polygon, jnp.minimum(side_x, side_y), big.radius)
    return (reach > cover + margin) & (small.is_polygon | big.is_polygon)


def insert(level: Level, p: Proposal) -> Level:
    """The level with the proposed body, and its joint, in the first free places."""
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
    """The joint's first body is the one with the smaller number."""
    model, joint = level.model, p.joint
    place = first_free(model.joint_active) & p.joined
    numbers = jnp.arange(level.size.bodies)[:, None]
    own, target = at(numbers, body), at(numbers, joint.target)
    target_first = target < own
    first, second = (
        where(target_first, joint.target_anchor, joint.anchor),
        where(target_first, joint.anchor, joint.target_anchor),
    )
    rotation = p.rotation - at(level.state.rotation, joint.target)
    rotation = jnp.where(joint.fixed, jnp.where(target_first, rotation, -rotation), 0.0)
    model = replace(
        model,
        joint_active=model.joint_active | place,
        joint_a=put(model.joint_a, place, jnp.minimum(own, target)),
        joint_b=put(model.joint_b, place, jnp.maximum(own, target)),
        joint_anchor_a=put(model.joint_anchor_a, place, unvec(first)),
        joint_anchor_b=put(model.joint_anchor_b, place, unvec(second)),
        joint_fixed=put(model.joint_fixed, place, joint.fixed),
        joint_rotation=put(model.joint_rotation, place, rotation),
        joint_limited=put(model.joint_limited, place, joint.limited),
        joint_min=put(model.joint_min, place, joint.limit_min),
        joint_max=put(model.joint_max, place, joint.limit_max),
        motor_on=put(model.motor_on, place, joint.motor_on),
        motor_speed=put(model.motor_speed, place, joint.motor_speed),
        motor_power=put(model.motor_power, place, joint.motor_power),
    )
    return replace(level, model=model, motor_binding=put(level.motor_binding, place, joint.motor_binding))


def add_thruster(
    level: Level, d: ThrusterDraws, wanted: Flag, candidates: Bool[Array, "body lane"], dist: Distribution
) -> Level:
    """A thruster on one of the movable candidates, which mostly pushes through its centre."""
    model, polygons = level.model, level.size.polygons
    candidates &= model.inverse_mass != 0
    body = choose(1.0 * candidates, d.body) & candidates
    low, high = extent(level, body)
    in_polygon = Vec(between(d.x, low.x, high.x), between(d.y, low.y, high.y))
    angle, radius = d.x * TURN, d.y * at(_radius(level), body)
    position = where(body[:polygons].any(0), in_polygon, Vec(radius * jnp.cos(angle), radius * jnp.sin(angle)))
    outward = position.scale(jnp.where(d.outward > 0.5, 1.0, -1.0))
    centred = (position.x == 0) & (position.y == 0)
    aligned = jnp.where(centred, 0.0, jnp.arctan2(outward.y, outward.x))
    power = between(d.power, dist.min_thruster_power, dist.max_thruster_power) * dist.thruster_power_factor
    place = first_free(model.thruster_active) & wanted & candidates.any(0)
    model = replace(
        model,
        thruster_active=model.thruster_active | place,
        thruster_body=put(model.thruster_body, place, at(jnp.arange(level.size.bodies)[:, None], body)),
        thruster_position=put(model.thruster_position, place, unvec(position)),
        thruster_rotation=put(
            model.thruster_rotation, place, jnp.where(d.aligned < dist.aligned_chance, aligned, d.angle * TURN)
        ),
        thruster_power=put(model.thruster_power, place, power * inverse(at(model.inverse_mass, body))),
    )
    binding = (d.binding * THRUSTER_BINDINGS).astype(jnp.int32)
    return replace(level, model=model, thruster_binding=put(level.thruster_binding, place, binding))


def _radius(level: Level) -> Float[Array, "body lane"]:
    """Of all bodies, zero for polygons."""
    lanes = level.model.radius.shape[-1]
    return jnp.concatenate([jnp.zeros((level.size.polygons, lanes)), level.model.radius])


def _origin(like: Lane) -> Vec:
    return Vec(jnp.zeros_like(like), jnp.zeros_like(like))


def _turned(v: Vec, angle: Lane) -> Vec:
    return v.rotate(jnp.cos(angle), jnp.sin(angle))


def _no_joint(level: Level) -> Joint:
    lanes = level.role.shape[-1]
    zero, no = jnp.zeros(lanes), jnp.zeros(lanes, bool)
    nobody = jnp.zeros((level.size.bodies, lanes), bool)
    return Joint(nobody, Vec(zero, zero), Vec(zero, zero), no, no, zero, zero, no, zero, zero, no.astype(jnp.int32))
