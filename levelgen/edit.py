"""Levels changed by hand: bodies placed, sized, turned, given roles and fixed, joints and thrusters put on them.

An edit is a pure function of one level, whose arrays have one lane, to another one. What is joined stays joined: who
moves or turns a body takes along all that joints hold to it. Masses are those of the sampler's bodies.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from levelproof.levelgen.frames import in_world, turned
from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, WORLD_SIDE, Level, Role, name_of
from levelproof.levelgen.sampling.scenery import NORMAL
from levelproof.levelgen.sampling.shuffle import separate
from levelproof.physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from levelproof.physics.types import FIXED_POLYGONS

HALF_SIDE = 0.25  # m, of a new body
SHAPES = {  # corners of a new polygon, in HALF_SIDE, clockwise around their mean
    "rectangle": ((-1, 1), (1, 1), (1, -1), (-1, -1)),
    "triangle": ((0, 4 / 3), (1.2, -2 / 3), (-1.2, -2 / 3)),
}
DENSITY = 1.0  # kg/m^2
SMALLEST, LARGEST = 0.05, 2.0  # m, of a body's reach from its centre
MOTOR_SPEED, MOTOR_POWER = 1.0, 1.0  # of a new motor, in units of the rules
THRUSTER_POWER = 1.0  # of a new thruster, in units of the rules

Point = tuple[float, float]  # m


class EditError(ValueError):
    """An edit that the level cannot have: one sentence."""


def add_body(level: Level, shape: str, x: float, y: float) -> Level:
    """A `circle`, `rectangle` or `triangle` with its centre there, plain and free to move."""
    circle = shape == "circle"
    if not circle and shape not in SHAPES:
        raise EditError(f"There is no shape {shape!r}: take circle, {', '.join(SHAPES)}.")

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
        model.active[body], model.collision_mode[body] = True, NORMAL
        model.friction[body], model.restitution[body] = 1.0, 0.0
        one.role[body], one.density[body] = Role.PLAIN, DENSITY
        one.state.position[body], one.state.rotation[body] = (x, y), 0.0
        one.state.velocity[body], one.state.angular_velocity[body] = 0.0, 0.0
        _weigh(one, body, fixed=False)

    return _edited(level, change)


def move(level: Level, body: int, x: float, y: float) -> Level:
    """A body's centre there, and what is joined to it along."""

    def change(one: Level) -> None:
        together = _together(one, body)
        one.state.position[together] += np.array((x, y), np.float32) - one.state.position[body]

    return _edited(level, change)


def turn(level: Level, body: int, angle: float) -> Level:
    """A body turned by so many radians, and what is joined to it around its centre."""

    def change(one: Level) -> None:
        together = _together(one, body)
        centre = one.state.position[body].copy()
        one.state.position[together] = centre + turned(one.state.position[together] - centre, angle)
        one.state.rotation[together] += angle

    return _edited(level, change)


def resize(level: Level, body: int, factor: float) -> Level:
    """A body so many times as large; what is joined to it moves with its joints."""

    def change(one: Level) -> None:
        _together(one, body)
        circle = body - one.size.polygons
        shape = one.model.radius[circle : circle + 1] if circle >= 0 else one.model.vertices[body]
        reach = factor * np.abs(shape).max()
        if not SMALLEST <= reach <= LARGEST:
            raise EditError(f"A body reaches from {SMALLEST} to {LARGEST} m from its centre, not {reach:.2f} m.")
        shape *= factor
        for anchor, of in _anchors(one):
            anchor[of == body] *= factor
        _weigh(one, body, fixed=not one.model.inverse_mass[body])
        _rejoin(one, body)

    return _edited(level, change)


def set_role(level: Level, body: int, role: int) -> Level:
    """A body plain, green, blue or red; the scenery's, too."""

    def change(one: Level) -> None:
        one.role[_there(one.model.active, body, "body")] = Role(role)

    return _edited(level, change)


def fix(level: Level, body: int, fixed: bool) -> Level:
    """A body that cannot move, or can again."""
    return _edited(level, lambda one: _weigh(one, _movable(one, body), fixed))


def add_joint(level: Level, x: float, y: float, fixed: bool = False) -> Level:
    """A joint at a point of two bodies: revolute, with a motor, or fixed."""

    def change(one: Level) -> None:
        found = [body for body in bodies_at(level, x, y) if body >= FIXED_POLYGONS][:2]
        if len(found) < 2:
            raise EditError("A joint holds two bodies together: put it where two of them overlap.")
        model, row = one.model, _free(one.model.joint_active, "joints", level)
        b, a = found
        model.joint_active[row], model.joint_a[row], model.joint_b[row] = True, a, b
        model.joint_anchor_a[row], model.joint_anchor_b[row] = _inside(one, a, x, y), _inside(one, b, x, y)
        model.joint_fixed[row], model.motor_on[row] = fixed, not fixed
        model.joint_rotation[row] = one.state.rotation[b] - one.state.rotation[a]
        model.joint_limited[row], model.joint_min[row], model.joint_max[row] = False, 0.0, 0.0
        model.motor_speed[row], model.motor_power[row] = MOTOR_SPEED, MOTOR_POWER
        one.motor_binding[row], one.motor_auto[row] = row % MOTOR_BINDINGS, False

    return _edited(level, change)


def add_thruster(level: Level, x: float, y: float, angle: float) -> Level:
    """A thruster on the uppermost body at a point. It pushes along `angle`, rad, its flame is on the other side."""

    def change(one: Level) -> None:
        found = [body for body in bodies_at(level, x, y) if body >= FIXED_POLYGONS]
        if not found:
            raise EditError("A thruster sits on a body: put it on one.")
        model, row, body = one.model, _free(one.model.thruster_active, "thrusters", level), found[0]
        model.thruster_active[row], model.thruster_body[row] = True, body
        model.thruster_position[row] = _inside(one, body, x, y)
        model.thruster_rotation[row] = angle - one.state.rotation[body]
        model.thruster_power[row] = THRUSTER_POWER
        one.thruster_binding[row] = row % THRUSTER_BINDINGS

    return _edited(level, change)


def bind(level: Level, kind: str, index: int, binding: int) -> Level:
    """Which entry of an action a `joint`'s motor or a `thruster` obeys."""

    def change(one: Level) -> None:
        bindings, most = _OF_KIND[kind][1](one), {"joint": MOTOR_BINDINGS, "thruster": THRUSTER_BINDINGS}[kind]
        bindings[_there(_OF_KIND[kind][0](one), index, kind)] = binding % most

    return _edited(level, change)


def delete(level: Level, kind: str, index: int) -> Level:
    """A `body` gone, with the joints and thrusters on it; or a `joint` or a `thruster`."""

    def change(one: Level) -> None:
        if kind != "body":
            active = _OF_KIND[kind][0](one)
            active[_there(active, index, kind)] = False
            return
        model, body = one.model, _movable(one, index)
        model.active[body], one.role[body] = False, Role.PLAIN
        model.joint_active[(model.joint_a == body) | (model.joint_b == body)] = False
        model.thruster_active[model.thruster_body == body] = False

    return _edited(level, change)


_OF_KIND: dict[str, tuple[Callable[[Level], Any], Callable[[Level], Any]]] = {
    "joint": (lambda one: one.model.joint_active, lambda one: one.motor_binding),
    "thruster": (lambda one: one.model.thruster_active, lambda one: one.thruster_binding),
}
EDITS: dict[str, Callable[..., Level]] = {
    edit.__name__: edit for edit in (add_body, move, turn, resize, set_role, fix, add_joint, add_thruster, bind, delete)
}


def bodies_at(level: Level, x: float, y: float) -> list[int]:
    """The bodies that a point lies in, the one that is drawn last first."""
    one = one_of(level)
    found = []
    for body in np.flatnonzero(one.model.active).tolist():
        inside = _inside(one, body, x, y)
        circle = body - one.size.polygons
        if circle >= 0:
            hit = np.hypot(*inside) <= one.model.radius[circle]
        else:
            corners = one.model.vertices[body][: one.model.n_vertices[body]]
            sides, to = np.roll(corners, -1, 0) - corners, inside - corners
            hit = (sides[:, 0] * to[:, 1] - sides[:, 1] * to[:, 0] <= 1e-6).all()
        if hit:
            found.append(body)
    return sorted(found, key=lambda body: (one.model.inverse_mass[body] != 0, body), reverse=True)


def one_of(level: Level) -> Level:
    """A level of one lane without its axis, as arrays of its own."""
    return jax.tree.map(lambda x: np.array(x)[..., 0], level)


def _edited(level: Level, change: Callable[[Level], None]) -> Level:
    """The level after `change` has written into its arrays; which bodies may collide is worked out anew."""
    one = one_of(level)
    change(one)
    after: Level = jax.tree.map(lambda x: np.asarray(x)[..., None], one)
    bodies = one.state.position[FIXED_POLYGONS:][one.model.active[FIXED_POLYGONS:]]
    if not np.isfinite(after.state.position).all() or np.abs(bodies).max(initial=0) > 2 * WORLD_SIDE:
        raise EditError("That is too far outside of the world.")
    return replace(after, model=replace(after.model, collides=np.asarray(separate(after.model))))


def _free(active: Any, kind: str, level: Level) -> int:
    """The first row that is not in use."""
    if active.all():
        raise EditError(f"Size {name_of(level.size)} has no room for more {kind}: delete one, or take a larger size.")
    return int(active.argmin())


def _there(active: Any, index: int, kind: str) -> int:
    if not 0 <= index < len(active) or not active[index]:
        raise EditError(f"There is no {kind} {index}.")
    return index


def _movable(one: Level, body: int) -> int:
    """A body that is there and not scenery."""
    if _there(one.model.active, body, "body") < FIXED_POLYGONS:
        raise EditError("That belongs to the scenery, of which only the role can change.")
    return body


def _together(one: Level, body: int) -> list[int]:
    """A body that can be moved, and all that moves with it."""
    found = _joined(one, _movable(one, body))
    if min(found) < FIXED_POLYGONS:
        raise EditError("A joint holds it to the scenery, which stays where it is: delete that joint first.")
    return found


def _weigh(one: Level, body: int, fixed: bool) -> None:
    """The inverse masses of a body's shape and density."""
    circle = body - one.size.polygons
    if circle >= 0:
        radius = one.model.radius[circle]
        area, inertia = circle_area(radius), circle_inertia(radius)
    else:
        corners, count = one.model.vertices[body][None, ..., None], one.model.n_vertices[body][None, None]
        area, inertia = polygon_area(corners, count)[0, 0], polygon_inertia(corners, count)[0, 0]
    for values, value in ((one.model.inverse_mass, area), (one.model.inverse_inertia, inertia)):
        values[body] = 0.0 if fixed else inverse(value * one.density[body])


def _joints(one: Level) -> Iterator[tuple[int, int, Any, Any]]:
    """Body, other body, and the joint's anchors on them, each active joint both ways round."""
    model = one.model
    for row in np.flatnonzero(model.joint_active):
        ends = (
            (int(model.joint_a[row]), model.joint_anchor_a[row]),
            (int(model.joint_b[row]), model.joint_anchor_b[row]),
        )
        for (a, anchor_a), (b, anchor_b) in (ends, ends[::-1]):
            yield a, b, anchor_a, anchor_b


def _joined(one: Level, body: int) -> list[int]:
    """A body and all that joints hold to it, near ones first."""
    found = [body]
    for here in found:
        found += [b for a, b, *_ in _joints(one) if a == here and b not in found]
    return found


def _rejoin(one: Level, body: int) -> None:
    """Move what is joined to a body so that the ends of joints meet again."""
    settled = _joined(one, body)
    for position, there in enumerate(settled):
        for a, b, anchor_a, anchor_b in _joints(one):
            if b == there and a in settled[:position]:
                one.state.position[b] = in_world(one.state, a, anchor_a) - turned(anchor_b, one.state.rotation[b])
                break


def _anchors(one: Level) -> Iterator[tuple[Any, Any]]:
    """Points in the frames of bodies, and which body each is of."""
    model = one.model
    yield model.joint_anchor_a, model.joint_a
    yield model.joint_anchor_b, model.joint_b
    yield model.thruster_position, model.thruster_body


def _inside(one: Level, body: int, x: float, y: float) -> np.ndarray:
    """A point of the world in the frame of a body."""
    return turned(np.array((x, y)) - one.state.position[body], -one.state.rotation[body])
