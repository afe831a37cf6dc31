"""Edits of levels by hand: add, move, turn, resize and fix bodies, set roles, attach joints and thrusters.

An edit is a pure function from one level, whose arrays have one lane, to another. Joined bodies stay joined: moving or
turning a body also moves every body that joints hold to it. Masses are computed as in the sampler.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from levelproof.levelgen.frames import in_world, turned
from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, WORLD_SIDE, Level, Role, name_of
from levelproof.levelgen.sampling.scenery import NORMAL
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from levelproof.physics.types import FIXED_POLYGONS

HALF_SIDE = 0.25  # m, of a new body
SHAPES = {  # corners of a new polygon, in HALF_SIDE, clockwise around their mean
    "rectangle": ((-1, 1), (1, 1), (1, -1), (-1, -1)),
    "triangle": ((0, 4 / 3), (1.2, -2 / 3), (-1.2, -2 / 3)),
}
DENSITY = 1.0  # kg/m^2
MIN_REACH, MAX_REACH = 0.05, 2.0  # m, from a body's centre
MOTOR_SPEED, MOTOR_POWER = 1.0, 1.0  # of a new motor, in units of task.physics
THRUSTER_POWER = 1.0  # of a new thruster, in units of task.physics

Point = tuple[float, float]  # m


class EditError(ValueError):
    """An edit that the level does not allow; its message is one sentence."""


def add_body(level: Level, shape: str, x: float, y: float) -> Level:
    """Add a `circle`, `rectangle` or `triangle` with its centre at (x, y), plain and free to move."""
    circle = shape == "circle"
    if not circle and shape not in SHAPES:
        raise EditError(f"Unknown shape {shape!r}: choose circle, {' or '.join(SHAPES)}.")

    def change(one: Level) -> None:
        model, first = one.model, one.size.polygons if circle else FIXED_POLYGONS
        rows = model.active[first : None if circle else one.size.polygons]
        body = first + _free(rows, "circles" if circle else "polygons", level)
        if circle:
            model.radius[body - first] = HALF_SIDE
        else:
            corners = np.array(SHAPES[shape], np.float32) * HALF_SIDE
            model.n_vertices[body], model.vertices[body] = len(corners), 0.0
            model.vertices[body][: len(corners)] = corners
            # Pixels draw a triangle's unused corner, too, as the reference does: put it on the triangle's closing side
            model.vertices[body][len(corners) :] = (corners[0] + corners[-1]) / 2
        model.active[body], model.collision_mode[body] = True, NORMAL
        model.friction[body], model.restitution[body] = 1.0, 0.0
        one.role[body], one.density[body] = Role.PLAIN, DENSITY
        one.state.position[body], one.state.rotation[body] = (x, y), 0.0
        one.state.velocity[body], one.state.angular_velocity[body] = 0.0, 0.0
        _weigh(one, body, fixed=False)

    return _edited(level, change)


def move(level: Level, body: int, x: float, y: float) -> Level:
    """Move a body's centre to (x, y); joined bodies shift equally."""

    def change(one: Level) -> None:
        group = _movable_group(one, body)
        one.state.position[group] += np.array((x, y), np.float32) - one.state.position[body]

    return _edited(level, change)


def turn(level: Level, body: int, angle: float) -> Level:
    """Turn a body by an angle, rad; joined bodies turn with it, around its centre."""

    def change(one: Level) -> None:
        group = _movable_group(one, body)
        centre = one.state.position[body].copy()
        one.state.position[group] = centre + turned(one.state.position[group] - centre, angle)
        one.state.rotation[group] += angle

    return _edited(level, change)


def resize(level: Level, body: int, factor: float) -> Level:
    """Scale a body by a factor; joined bodies move with their joints."""

    def change(one: Level) -> None:
        _movable_group(one, body)
        circle = body - one.size.polygons
        shape = one.model.radius[circle : circle + 1] if circle >= 0 else one.model.vertices[body]
        corners = shape if circle >= 0 else np.linalg.norm(shape[: one.model.n_vertices[body]], axis=-1)
        reach = factor * corners.max()
        if not MIN_REACH <= reach <= MAX_REACH:
            raise EditError(
                f"The body would reach {reach:.2f} m from its centre: keep it between {MIN_REACH} and {MAX_REACH} m."
            )
        shape *= factor
        for points, bodies in _anchors(one):
            points[bodies == body] *= factor
        _weigh(one, body, fixed=not one.model.inverse_mass[body])
        _rejoin(one, body)

    return _edited(level, change)


def set_role(level: Level, body: int, role: int) -> Level:
    """Make a body plain, green, blue or red; the scenery allows it, too."""

    def change(one: Level) -> None:
        one.role[_active(one.model.active, body, "body")] = Role(role)

    return _edited(level, change)


def fix(level: Level, body: int, fixed: bool) -> Level:
    """Fix a body in place, or free it."""

    def change(one: Level) -> None:
        _weigh(one, _movable(one, body), fixed)
        if fixed:  # the engine moves whatever has a velocity, as the reference does
            one.state.velocity[body], one.state.angular_velocity[body] = 0.0, 0.0

    return _edited(level, change)


def add_joint(level: Level, x: float, y: float, fixed: bool = False) -> Level:
    """Join the two uppermost bodies at a point, by a revolute joint with a motor or by a fixed joint."""

    def change(one: Level) -> None:
        ends = [body for body in bodies_at(level, x, y) if body >= FIXED_POLYGONS][:2]
        if len(ends) < 2:
            raise EditError("A joint holds two bodies together: put it where two of them overlap.")
        model, row = one.model, _free(one.model.joint_active, "joints", level)
        b, a = ends
        model.joint_active[row], model.joint_a[row], model.joint_b[row] = True, a, b
        model.joint_anchor_a[row], model.joint_anchor_b[row] = _inside(one, a, x, y), _inside(one, b, x, y)
        model.joint_fixed[row], model.motor_on[row] = fixed, not fixed
        model.joint_rotation[row] = one.state.rotation[b] - one.state.rotation[a]
        model.joint_limited[row], model.joint_min[row], model.joint_max[row] = False, 0.0, 0.0
        model.motor_speed[row], model.motor_power[row] = MOTOR_SPEED, MOTOR_POWER
        one.motor_binding[row], one.motor_auto[row] = row % MOTOR_BINDINGS, False
        one.state.joint_impulse[row], one.state.joint_angular_impulse[row] = 0.0, 0.0  # not those of a deleted joint

    return _edited(level, change)


def add_thruster(level: Level, x: float, y: float, angle: float) -> Level:
    """Put a thruster on the uppermost body at a point. It pushes along `angle`, rad; its flame is opposite."""

    def change(one: Level) -> None:
        candidates = [body for body in bodies_at(level, x, y) if body >= FIXED_POLYGONS]
        if not candidates:
            raise EditError("A thruster sits on a body: put it on one.")
        model, row, body = one.model, _free(one.model.thruster_active, "thrusters", level), candidates[0]
        model.thruster_active[row], model.thruster_body[row] = True, body
        model.thruster_position[row] = _inside(one, body, x, y)
        model.thruster_rotation[row] = angle - one.state.rotation[body]
        model.thruster_power[row] = THRUSTER_POWER
        one.thruster_binding[row] = row % THRUSTER_BINDINGS

    return _edited(level, change)


def bind(level: Level, kind: str, index: int, binding: int) -> Level:
    """Choose the entry of an action that a `joint`'s motor or a `thruster` obeys."""

    def change(one: Level) -> None:
        of_kind = ACTUATORS[kind]
        of_kind.bindings(one)[_active(of_kind.active(one), index, kind)] = binding % of_kind.entries

    return _edited(level, change)


def delete(level: Level, kind: str, index: int) -> Level:
    """Delete a body with its joints and thrusters, or one joint or thruster."""

    def change(one: Level) -> None:
        if kind != "body":
            active = ACTUATORS[kind].active(one)
            active[_active(active, index, kind)] = False
            return
        model, body = one.model, _movable(one, index)
        model.active[body], one.role[body] = False, Role.PLAIN
        model.joint_active[(model.joint_a == body) | (model.joint_b == body)] = False
        model.thruster_active[model.thruster_body == body] = False

    return _edited(level, change)


class Actuators(NamedTuple):
    """A kind of actuators of a level."""

    active: Callable[[Level], Any]  # returns their flags
    bindings: Callable[[Level], Any]
    entries: int  # of an action, which they may be bound to


ACTUATORS = {
    "joint": Actuators(lambda one: one.model.joint_active, lambda one: one.motor_binding, MOTOR_BINDINGS),
    "thruster": Actuators(lambda one: one.model.thruster_active, lambda one: one.thruster_binding, THRUSTER_BINDINGS),
}
EDITS: dict[str, Callable[..., Level]] = {
    edit.__name__: edit for edit in (add_body, move, turn, resize, set_role, fix, add_joint, add_thruster, bind, delete)
}


def bodies_at(level: Level, x: float, y: float) -> list[int]:
    """Return the bodies that contain a point, the uppermost (drawn last) first."""
    one = one_of(level)
    hits = []
    for body in np.flatnonzero(one.model.active).tolist():
        inside = _inside(one, body, x, y)
        circle = body - one.size.polygons
        if circle >= 0:
            hit = np.hypot(*inside) <= one.model.radius[circle]
        else:
            corners = one.model.vertices[body][: one.model.n_vertices[body]]
            sides, offset = np.roll(corners, -1, 0) - corners, inside - corners
            hit = (sides[:, 0] * offset[:, 1] - sides[:, 1] * offset[:, 0] <= 1e-6).all()
        if hit:
            hits.append(body)
    return sorted(hits, key=lambda body: (one.model.inverse_mass[body] != 0, body), reverse=True)


def one_of(level: Level) -> Level:
    """Copy a level of one lane to numpy arrays without the lane axis."""
    return jax.tree.map(lambda x: np.array(x)[..., 0], level)


def _edited(level: Level, change: Callable[[Level], None]) -> Level:
    """Return the level with its arrays modified by `change`; recompute which bodies may collide."""
    one = one_of(level)
    change(one)
    after: Level = jax.tree.map(lambda x: np.asarray(x)[..., None], one)
    position, active = (np.asarray(x)[..., 0] for x in (level.state.position, level.model.active))
    placed = (one.state.position != position).any(-1) | ~active  # moved or added
    placed &= one.model.active & (np.arange(len(placed)) >= FIXED_POLYGONS)
    far = np.abs(one.state.position[placed]).max(initial=0) > 2 * WORLD_SIDE
    if far or not np.isfinite(after.state.position).all():
        raise EditError(
            "A body would lie too far outside the world: "
            f"keep its coordinates between {-2 * WORLD_SIDE:g} and {2 * WORLD_SIDE:g} m."
        )
    return replace(after, model=replace(after.model, collides=np.asarray(collision_matrix(after.model))))


def _free(active: Any, kind: str, level: Level) -> int:
    """Return the first inactive row; if there is none, raise EditError. `kind` names the rows in its message."""
    if active.all():
        raise EditError(f"Size {name_of(level.size)} has no room for more {kind}: delete one, or use a larger size.")
    return int(active.argmin())


def _active(active: Any, index: int, kind: str) -> int:
    """Return the index if the body, joint or thruster there is active, else raise EditError."""
    if not 0 <= index < len(active) or not active[index]:
        raise EditError(f"There is no {kind} {index}.")
    return index


def _movable(one: Level, body: int) -> int:
    """Return the index of an active body that is not scenery, else raise EditError."""
    if _active(one.model.active, body, "body") < FIXED_POLYGONS:
        raise EditError("That belongs to the scenery: only its role can change.")
    return body


def _movable_group(one: Level, body: int) -> list[int]:
    """Return a body and all bodies that move with it; raise EditError if one of them is scenery."""
    group = _joined(one, _movable(one, body))
    if min(group) < FIXED_POLYGONS:
        raise EditError("Joints hold this body to the scenery, which cannot move: delete a joint between them first.")
    return group


def _weigh(one: Level, body: int, fixed: bool) -> None:
    """Set a body's inverse mass and inertia from its shape and density."""
    circle = body - one.size.polygons
    if circle >= 0:
        radius = one.model.radius[circle]
        area, inertia = circle_area(radius), circle_inertia(radius)
    else:
        corners, count = one.model.vertices[body][None, ..., None], one.model.n_vertices[body][None, None]
        area, inertia = (np.asarray(x)[0, 0] for x in _area_and_inertia(corners, count))
    for values, value in ((one.model.inverse_mass, area), (one.model.inverse_inertia, inertia)):
        values[body] = 0.0 if fixed else inverse(value * one.density[body])


# Compiled, because eagerly it takes a hundred times as long
_area_and_inertia = jax.jit(lambda corners, count: (polygon_area(corners, count), polygon_inertia(corners, count)))


def _joints(one: Level) -> Iterator[tuple[int, int, Any, Any]]:
    """Yield (body, other body, anchor on the body, anchor on the other): every active joint twice, from either end."""
    model = one.model
    for row in np.flatnonzero(model.joint_active):
        ends = (
            (int(model.joint_a[row]), model.joint_anchor_a[row]),
            (int(model.joint_b[row]), model.joint_anchor_b[row]),
        )
        for (a, anchor_a), (b, anchor_b) in (ends, ends[::-1]):
            yield a, b, anchor_a, anchor_b


def _joined(one: Level, body: int) -> list[int]:
    """Return a body and all bodies that joints hold to it, directly or not; nearest first."""
    group = [body]
    for member in group:  # visits the bodies appended below, too
        group += [b for a, b, *_ in _joints(one) if a == member and b not in group]
    return group


def _rejoin(one: Level, body: int) -> None:
    """Move the bodies joined to a body so that joints meet again; in a loop of joints, one may stay apart."""
    group = _joined(one, body)
    for rank, member in enumerate(group):
        for a, b, anchor_a, anchor_b in _joints(one):
            if b == member and a in group[:rank]:
                one.state.position[b] = in_world(one.state, a, anchor_a) - turned(anchor_b, one.state.rotation[b])
                break


def _anchors(one: Level) -> Iterator[tuple[Any, Any]]:
    """Yield arrays of points in body frames, each with the indices of their bodies."""
    model = one.model
    yield model.joint_anchor_a, model.joint_a
    yield model.joint_anchor_b, model.joint_b
    yield model.thruster_position, model.thruster_body


def _inside(one: Level, body: int, x: float, y: float) -> np.ndarray:
    """Transform a point from the world to a body's frame."""
    return turned(np.array((x, y)) - one.state.position[body], -one.state.rotation[body])
