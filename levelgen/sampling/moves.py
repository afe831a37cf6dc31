"""The sampler's moves: propose a free body, propose a body joined to another, add a thruster.

They follow `kinetix.environment.ued.mutators` 3.0.2: `propose_free` is mutate_add_shape, `propose_connected` is
mutate_add_connected_shape, `add_thruster` is mutate_add_thruster. Their numbers are fields of `Distribution`.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import HALF_WORLD, MOTOR_BINDINGS, THRUSTER_BINDINGS, WORLD_SIDE, Level, Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draws import at, between, choose, first_free, first_of_two, put
from levelproof.levelgen.sampling.proposal import (
    BodyDraws,
    BodyShape,
    Flag,
    Joint,
    Lane,
    Proposal,
    draw_role,
    draw_shape,
    shape_mass,
    turned,
)
from levelproof.levelgen.sampling.scenery import FLOOR_TOP
from levelproof.physics.mass import inverse
from levelproof.physics.types import FIXED_POLYGONS
from levelproof.physics.vector import Vec, unvec, vec, where

TURN = 2 * math.pi  # rad, a full turn


class ThrusterDraws(NamedTuple):
    """Random numbers of one thruster, each [lane]."""

    wanted: Lane
    body: Lane
    x: Lane
    y: Lane
    outward: Lane
    aligned: Lane
    angle: Lane
    power: Lane
    binding: Lane


def propose_free(level: Level, d: BodyDraws, may_be_fixed: Flag, joint: Joint, dist: Distribution) -> Proposal:
    """Propose a body above the floor, without a joint. `joint` fills the unused field of the result."""
    room_polygon, room_circle = has_room(level)
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
    never = jnp.zeros_like(fixed)
    return Proposal(
        possible=room_polygon | room_circle,
        shape=shape,
        position=Vec(position.x, position.y - lower),
        rotation=d.rotation * TURN,
        role=role,
        fixed=fixed,
        joined=never,
        joint=joint,
        hidden=never,
    )


def free_position(d: BodyDraws, shape: BodyShape, role: Int[Array, " lane"], dist: Distribution) -> Vec:
    """Draw a position whose body lies within the world; if on opposite sides, green goes left and blue right."""
    reach = jnp.maximum(jnp.maximum(shape.half.x, shape.half.y) * math.sqrt(2), shape.radius)
    opposite = d.opposite < dist.opposite_sides_chance
    low = reach + jnp.where(opposite & (role == Role.BLUE), HALF_WORLD, 0.0)
    high = WORLD_SIDE - reach - jnp.where(opposite & (role == Role.GREEN), HALF_WORLD, 0.0)
    return Vec(between(d.x, low, high), between(d.y, reach + FLOOR_TOP, WORLD_SIDE - reach))


def propose_connected(level: Level, d: BodyDraws, revolute: Flag, dist: Distribution) -> Proposal:
    """Propose a body joined to an existing one, even if that puts it outside the world."""
    model, polygons = level.model, level.size.polygons
    room_polygon, room_circle = has_room(level)
    weight = target_weights(level, dist)
    any_polygon = model.active[FIXED_POLYGONS:polygons].any(0)
    any_circle = (weight[polygons:] > 0).any(0)
    target_is_polygon = first_of_two(any_polygon, any_circle, d.target_is_polygon) | ~room_polygon
    is_polygon = first_of_two(room_polygon, room_circle, d.is_polygon, dist.connected_circle_chance)
    is_polygon |= ~target_is_polygon & room_polygon  # a circle is not joined to a circle
    shape = draw_shape(d, is_polygon, dist.max_size, dist)
    target = choose_target(level, weight, target_is_polygon, d.target)

    half = shape.half.scale(1.0 * is_polygon)  # circles are joined at their centres
    anchor = point_between(d.anchor_x, d.anchor_y, -half, half)
    low, high = extent(level, target)
    target_anchor = point_between(d.target_anchor_x, d.target_anchor_y, low, high)
    rotation = d.rotation * TURN
    meet = vec(at(level.state.position, target)) + turned(target_anchor, at(level.state.rotation, target))
    role = draw_role(level, d.role, at(level.role, target) == Role.PLAIN, dist)
    joint = draw_joint(level, d, (target, anchor, target_anchor), is_polygon & target_is_polygon, revolute, dist)
    partner = BodyShape(target_is_polygon, (high - low).scale(0.5), at(radii(level), target))
    possible = (room_polygon | room_circle) & model.active[FIXED_POLYGONS:].any(0) & ~model.joint_active.all(0)
    return Proposal(
        possible=possible,
        shape=shape,
        position=meet - turned(anchor, rotation),
        rotation=rotation,
        role=role,
        fixed=jnp.zeros_like(possible),
        joined=possible,
        joint=joint,
        hidden=~both_visible(shape, partner, anchor, target_anchor, dist),
    )


def target_weights(level: Level, dist: Distribution) -> Float[Array, "body lane"]:
    """Return each body's weight as a joint's target: it falls with every joint, and is small for fixed bodies."""
    model, bodies = level.model, level.size.bodies
    body = jnp.arange(bodies)[:, None]
    ends = ((model.joint_a[:, None] == body) * 1.0 + (model.joint_b[:, None] == body)) * model.joint_active[:, None]
    joints = ends.sum(0)
    free = jnp.where(
        body < level.size.polygons,
        jnp.maximum(1 - joints / dist.polygon_connections, 0.0),
        joints == 0,
    )
    movable = jnp.where(model.inverse_mass == 0, dist.fixed_target_weight, 1.0)
    return jnp.where(model.active & (body >= FIXED_POLYGONS), free * movable, 0.0)


def choose_target(
    level: Level, weight: Float[Array, "body lane"], is_polygon: Flag, u: Lane
) -> Bool[Array, "body lane"]:
    """Choose a polygon (if all have their joints: any, scenery included) or a circle without a joint."""
    polygons = level.size.polygons
    any_left = (weight[:polygons] > 0).any(0)
    among_polygons = jnp.where(any_left, weight[:polygons], level.model.active[:polygons])
    circles = weight[polygons:]
    parts = [choose(among_polygons, u) & is_polygon]
    if level.size.circles:
        parts.append(choose(circles, u) & ~is_polygon)
    return jnp.concatenate(parts)


def point_between(x: Lane, y: Lane, low: Vec, high: Vec) -> Vec:
    """Return a point between two corners."""
    return Vec(between(x, low.x, high.x), between(y, low.y, high.y))


def draw_joint(
    level: Level, d: BodyDraws, ends: tuple[Array, Vec, Vec], polygons: Flag, revolute: Flag, dist: Distribution
) -> Joint:
    """Draw a joint and its motor.

    Args:
        level: the level so far.
        d: random numbers.
        ends: target and anchors, the first three fields of Joint.
        polygons: whether the joint connects two polygons.
        revolute: whether the joint must be revolute.
        dist: the distribution.
    """
    model = level.model
    enough = (model.joint_active & ~model.joint_fixed).sum(0) >= dist.min_revolute_joints
    fixed = (d.joint_fixed < dist.fixed_joint_chance) & enough & ~revolute
    turns = ~fixed
    limited = turns & polygons & (d.limited < dist.limit_chance)
    max_power = jnp.where(polygons, dist.max_motor_power, dist.max_wheel_power)
    return Joint(
        *ends,
        joint_fixed=fixed,
        joint_limited=limited,
        joint_min=jnp.where(limited, between(d.limit_min, -dist.max_limit, 0.0), 0.0),
        joint_max=jnp.where(limited, between(d.limit_max, 0.0, dist.max_limit), 0.0),
        motor_on=turns & (d.motor < dist.motor_chance),
        motor_speed=jnp.where(turns, between(d.motor_speed, dist.min_motor_speed, dist.max_motor_speed), 0.0),
        motor_power=jnp.where(turns, between(d.motor_power, dist.min_motor_power, max_power), 0.0),
        motor_binding=(d.motor_binding * MOTOR_BINDINGS).astype(jnp.int32),
    )


def both_visible(new: BodyShape, target: BodyShape, anchor: Vec, target_anchor: Vec, dist: Distribution) -> Flag:
    """Whether each of two joined bodies can be seen beside the other at some angle of their joint.

    As in the reference: if the target is the joint's first body (always, except for a new polygon on a circle), each
    body is tested with the OTHER one's anchor.
    """
    exchanged = ~new.is_polygon | target.is_polygon
    new_anchor, other_anchor = where(exchanged, target_anchor, anchor), where(exchanged, anchor, target_anchor)
    margin = dist.visible_margin
    return _reaches_beyond(new, target, new_anchor, other_anchor, margin) & _reaches_beyond(
        target, new, other_anchor, new_anchor, margin
    )


def _reaches_beyond(small: BodyShape, big: BodyShape, small_anchor: Vec, big_anchor: Vec, margin: float) -> Flag:
    """Whether the farthest corner (or radius) of `small` reaches beyond the nearest side (or radius) of `big`."""
    far_x, far_y = (half + jnp.abs(p) for half, p in zip(small.half, small_anchor, strict=True))
    farthest = Vec(far_x, far_y).norm()
    reach = jnp.where(small.is_polygon, farthest, small.radius)
    side_x, side_y = (half - jnp.abs(p) for half, p in zip(big.half, big_anchor, strict=True))
    cover = jnp.where(big.is_polygon, jnp.minimum(side_x, side_y), big.radius)
    return (reach > cover + margin) & (small.is_polygon | big.is_polygon)


def add_thruster(
    level: Level, d: ThrusterDraws, wanted: Flag, candidates: Bool[Array, "body lane"], dist: Distribution
) -> Level:
    """Add a thruster to one of the movable candidates; if `aligned`, it pushes through the body's centre."""
    model, polygons = level.model, level.size.polygons
    candidates &= model.inverse_mass != 0
    body = choose(1.0 * candidates, d.body) & candidates
    low, high = extent(level, body)
    in_polygon = point_between(d.x, d.y, low, high)
    angle, radius = d.x * TURN, d.y * at(radii(level), body)
    position = where(body[:polygons].any(0), in_polygon, Vec(radius * jnp.cos(angle), radius * jnp.sin(angle)))
    outward = position.scale(jnp.where(d.outward > 0.5, 1.0, -1.0))
    centred = (position.x == 0) & (position.y == 0)
    aligned = jnp.where(centred, 0.0, jnp.arctan2(outward.y, outward.x))
    power = between(d.power, dist.min_thruster_power, dist.max_thruster_power) * dist.thruster_power_factor
    row = first_free(model.thruster_active) & wanted & candidates.any(0)
    model = replace(
        model,
        thruster_active=model.thruster_active | row,
        thruster_body=put(model.thruster_body, row, at(jnp.arange(level.size.bodies)[:, None], body)),
        thruster_position=put(model.thruster_position, row, unvec(position)),
        thruster_rotation=put(
            model.thruster_rotation, row, jnp.where(d.aligned < dist.aligned_chance, aligned, d.angle * TURN)
        ),
        thruster_power=put(model.thruster_power, row, power * inverse(at(model.inverse_mass, body))),
    )
    binding = (d.binding * THRUSTER_BINDINGS).astype(jnp.int32)
    return replace(level, model=model, thruster_binding=put(level.thruster_binding, row, binding))


def has_room(level: Level) -> tuple[Flag, Flag]:
    """Whether one more polygon fits, and one more circle."""
    polygons = level.size.polygons
    return ~level.model.active[:polygons].all(0), ~level.model.active[polygons:].all(0)


def extent(level: Level, chosen: Bool[Array, "body lane"]) -> tuple[Vec, Vec]:
    """Return the lower left and upper right corner of the chosen polygon in its own frame; zero for circles."""
    vertices = level.model.vertices
    polygon = chosen[: level.size.polygons]
    return vec(at(vertices.min(1), polygon)), vec(at(vertices.max(1), polygon))


def radii(level: Level) -> Float[Array, "body lane"]:
    """Return the radius of every body, zero for polygons, m."""
    lanes = level.model.radius.shape[-1]
    return jnp.concatenate([jnp.zeros((level.size.polygons, lanes)), level.model.radius])
