"""The sampler's moves: propose a free body, propose a body joined to another, add a thruster.

They follow `kinetix.environment.ued.mutators` 3.0.2: `propose_free` is mutate_add_shape, `propose_connected` is
mutate_add_connected_shape, `add_thruster` is mutate_add_thruster. Their numbers are fields of `Distribution`.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from levelproof.levelgen.level import HALF_WORLD, MOTOR_BINDINGS, THRUSTER_BINDINGS, WORLD_SIDE, Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draft import Draft, read_body
from levelproof.levelgen.sampling.draws import between, cumulate, first_of_two, pick_row
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
)
from levelproof.levelgen.sampling.scenery import FLOOR_TOP
from levelproof.physics.lanes import NOBODY, Scalar, gather, put
from levelproof.physics.mass import inverse
from levelproof.physics.trigonometry import angle_of, cos_sin
from levelproof.physics.types import FIXED_POLYGONS
from levelproof.physics.vector import Vec, unvec, where

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


def propose_free(draft: Draft, d: BodyDraws, may_be_fixed: Flag, joint: Joint, dist: Distribution) -> Proposal:
    """Propose a body above the floor, without a joint. `joint` fills the unused field of the result."""
    room_polygon, room_circle = has_room(draft)
    is_polygon = first_of_two(room_polygon, room_circle, d.is_polygon)
    role = draw_role(draft, d.role, True, dist)
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
    """Draw a position that keeps the body within the world; if on opposite sides, green goes left and blue right."""
    reach = jnp.maximum(jnp.maximum(shape.half.x, shape.half.y) * math.sqrt(2), shape.radius)
    opposite = d.opposite < dist.opposite_sides_chance
    low = reach + jnp.where(opposite & (role == Role.BLUE), HALF_WORLD, 0.0)
    high = WORLD_SIDE - reach - jnp.where(opposite & (role == Role.GREEN), HALF_WORLD, 0.0)
    return Vec(between(d.x, low, high), between(d.y, reach + FLOOR_TOP, WORLD_SIDE - reach))


def propose_connected(draft: Draft, d: BodyDraws, revolute: Flag, dist: Distribution) -> Proposal:
    """Propose a body joined to an existing one, even if that puts it outside the world.

    `weigh_targets` must have run since the last body was added.
    """
    used = draft.used
    room_polygon, room_circle = has_room(draft)
    any_polygon = used.polygons[...] > FIXED_POLYGONS
    any_circle = draft.notes.upper[draft.size.bodies - 1] > 0 if draft.size.circles else jnp.zeros_like(any_polygon)
    target_is_polygon = first_of_two(any_polygon, any_circle, d.target_is_polygon) | ~room_polygon
    is_polygon = first_of_two(room_polygon, room_circle, d.is_polygon, dist.connected_circle_chance)
    is_polygon |= ~target_is_polygon & room_polygon  # a circle is not joined to a circle
    shape = draw_shape(d, is_polygon, dist.max_size, dist)
    chosen = choose_target(draft, target_is_polygon, d.target)
    target = gather(draft.size.bodies, lambda i: read_body(draft, i), chosen)

    half = shape.half.scale(1.0 * is_polygon)  # circles are joined at their centres
    anchor = point_between(d.anchor_x, d.anchor_y, -half, half)
    target_anchor = point_between(d.target_anchor_x, d.target_anchor_y, target.low, target.high)
    rotation = d.rotation * TURN
    meet = target.position + target_anchor.rotate(target.cos, target.sin)
    role = draw_role(draft, d.role, target.role == Role.PLAIN, dist)
    joint = draw_joint(draft, d, (chosen, anchor, target_anchor), is_polygon & target_is_polygon, revolute, dist)
    partner = BodyShape(target_is_polygon, (target.high - target.low).scale(0.5), target.reach)
    anyone = any_polygon | (used.circles[...] > 0)
    possible = (room_polygon | room_circle) & anyone & (used.joints[...] < draft.size.joints)
    return Proposal(
        possible=possible,
        shape=shape,
        position=meet - anchor.rotate(*cos_sin(rotation)),
        rotation=rotation,
        role=role,
        fixed=jnp.zeros_like(possible),
        joined=possible,
        joint=joint,
        hidden=~both_visible(shape, partner, anchor, target_anchor, dist),
    )


def weigh_targets(draft: Draft, dist: Distribution) -> None:
    """Write the cumulative weights of bodies as a joint's target, separately for polygons and circles.

    A body's weight falls with each of its joints, and is small if the body is fixed. A circle has at most one joint. If
    all polygons have their joints, any polygon may be chosen, scenery included.
    """
    rows, used, notes = draft.rows, draft.used, draft.notes
    polygons, bodies = draft.size.polygons, draft.size.bodies
    movable = lambda i: jnp.where(rows.inverse_mass[i] == 0, dist.fixed_target_weight, 1.0)

    def polygon(i):
        free = jnp.maximum(1 - notes.joints[i] / dist.polygon_connections, 0.0)
        return jnp.where((i >= FIXED_POLYGONS) & (i < used.polygons[...]), free * movable(i), 0.0)

    def circle(i):
        return jnp.where((notes.joints[i] == 0) & (i - polygons < used.circles[...]), movable(i), 0.0)

    cumulate(notes.upper, 0, polygons, polygon)
    none_left = notes.upper[polygons - 1] == 0
    any_polygon = lambda i: jnp.where(none_left, 1.0 * (i < used.polygons[...]), polygon(i))
    cumulate(notes.upper, 0, polygons, any_polygon)
    cumulate(notes.upper, polygons, bodies, circle)


def choose_target(draft: Draft, is_polygon: Flag, u: Lane) -> Int[Array, " lane"]:
    """Choose a polygon or a circle by the weights of `weigh_targets`; return its row."""
    polygons, bodies = draft.size.polygons, draft.size.bodies
    polygon = pick_row(draft.notes.upper, 0, polygons, u)
    return (
        jnp.where(is_polygon, polygon, pick_row(draft.notes.upper, polygons, bodies, u))
        if bodies > polygons
        else polygon
    )


def point_between(x: Lane, y: Lane, low: Vec, high: Vec) -> Vec:
    """Return the point at fractions x and y of the way between two corners."""
    return Vec(between(x, low.x, high.x), between(y, low.y, high.y))


def draw_joint(
    draft: Draft, d: BodyDraws, ends: tuple[Array, Vec, Vec], polygons: Flag, revolute: Flag, dist: Distribution
) -> Joint:
    """Draw a joint and its motor.

    Args:
        draft: the level so far.
        d: random numbers.
        ends: target and anchors, the first three fields of Joint.
        polygons: whether the joint connects two polygons.
        revolute: whether the joint must be revolute.
        dist: the distribution.
    """
    enough = draft.used.revolute[...] >= dist.min_revolute_joints
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


def add_thruster(draft: Draft, d: ThrusterDraws, wanted: Flag, latest: Scalar, dist: Distribution) -> None:
    """Add a thruster to a movable body that existed after turn `latest`; an aligned one pushes through its centre."""
    rows, used, notes, bodies = draft.rows, draft.used, draft.notes, draft.size.bodies
    may_push = lambda i: rows.active[i] & (rows.inverse_mass[i] != 0) & (notes.turn[i] <= latest)
    cumulate(notes.upper, 0, bodies, lambda i: 1.0 * may_push(i))
    anyone = notes.upper[bodies - 1] > 0
    chosen = jnp.where(anyone, pick_row(notes.upper, 0, bodies, d.body), NOBODY)
    body = gather(bodies, lambda i: read_body(draft, i), chosen)
    cos, sin = cos_sin(d.x * TURN)
    radius = d.y * body.reach
    in_polygon = point_between(d.x, d.y, body.low, body.high)
    position = where(chosen < draft.size.polygons, in_polygon, Vec(radius * cos, radius * sin))
    outward = position.scale(jnp.where(d.outward > 0.5, 1.0, -1.0))
    power = between(d.power, dist.min_thruster_power, dist.max_thruster_power) * dist.thruster_power_factor
    added = wanted & anyone
    put(
        jnp.where(added, used.thrusters[...], NOBODY),
        (rows.thruster_active, True),
        (rows.thruster_body, chosen),
        (rows.thruster_position, unvec(position)),
        (rows.thruster_rotation, jnp.where(d.aligned < dist.aligned_chance, angle_of(*outward), d.angle * TURN)),
        (rows.thruster_power, power * inverse(body.inverse_mass)),
        (rows.thruster_binding, (d.binding * THRUSTER_BINDINGS).astype(jnp.int32)),
    )
    used.thrusters[...] += added


def has_room(draft: Draft) -> tuple[Flag, Flag]:
    """Whether one more polygon fits, and one more circle."""
    return draft.used.polygons[...] < draft.size.polygons, draft.used.circles[...] < draft.size.circles
