"""Levels and witnesses in few bytes for the pages of a gallery: numbers of 16 bits, as `site/draw.js` reads them.

A world is a list of numbers: how many bodies, joints and thrusters it has, then each of them. Bodies that cannot move
come first, so they lie behind. Lengths are counted in LENGTH, angles in ANGLE.
"""

from base64 import b64encode

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from levelproof.levelgen.level import Level
from levelproof.physics.types import MAX_VERTICES

LENGTH = 1 / 2000  # m; 16 bits reach 16.4 m to either side, and the engine keeps bodies within 15 m
ANGLE = 1 / 10_000  # rad, of -pi to pi
MOST = 2**15 - 1


def lengths(values: ArrayLike) -> Int[np.ndarray, "..."]:
    """Metres as whole numbers of LENGTH, as far as 16 bits reach."""
    return np.clip(np.nan_to_num(np.asarray(values) / LENGTH), -MOST, MOST).round().astype(np.int16)


def angles(values: ArrayLike) -> Int[np.ndarray, "..."]:
    """Radians as whole numbers of ANGLE, within a turn."""
    turn, known = 2 * np.pi, np.nan_to_num(np.asarray(values, np.float64))
    within = known - turn * np.round(known / turn)
    return (within / ANGLE).round().astype(np.int16)


def text_of(numbers: np.ndarray) -> str:
    """The bytes of numbers, little ends first, as text."""
    return b64encode(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes()).decode()


def drawn_bodies(level: Level) -> tuple[Int[np.ndarray, " body"], int]:
    """The numbers of ONE level's bodies (no lane axis) in the order of drawing, and how many of them cannot move."""
    present = np.flatnonzero(level.model.active)
    moves = np.asarray(level.model.inverse_mass)[present] != 0
    return present[np.argsort(moves, kind="stable")], int((~moves).sum())


def world_of(level: Level) -> str:
    """ONE level (no lane axis) as it is drawn at the start."""
    model, (bodies, still) = level.model, drawn_bodies(level)
    place = np.full(level.size.bodies, len(bodies))
    place[bodies] = np.arange(len(bodies))
    position, rotation = lengths(level.state.position), angles(level.state.rotation)
    corners, radius = lengths(model.vertices), lengths(model.radius)
    joints, thrusters = np.flatnonzero(model.joint_active), np.flatnonzero(model.thruster_active)
    numbers = [len(bodies), still, len(joints), len(thrusters)]
    for body in bodies:
        circle = body - level.size.polygons
        shape = [radius[circle]] if circle >= 0 else corners[body][: model.n_vertices[body]].ravel()
        count = 0 if circle >= 0 else min(int(model.n_vertices[body]), MAX_VERTICES)
        numbers += [level.role[body], count, *position[body], rotation[body], *shape]
    anchors = lengths(model.joint_anchor_a)
    for joint in joints:
        fixed, motor, auto = model.joint_fixed[joint], model.motor_on[joint], level.motor_auto[joint]
        kind = int(fixed) + 2 * int(motor) + 4 * int(auto)
        numbers += [place[model.joint_a[joint]], *anchors[joint], kind, level.motor_binding[joint]]
    spots, turns = lengths(model.thruster_position), angles(model.thruster_rotation)
    for thruster in thrusters:
        at, binding = place[model.thruster_body[thruster]], level.thruster_binding[thruster]
        numbers += [at, *spots[thruster], turns[thruster], binding]
    return text_of(np.array(numbers, np.int16))


def states_of(
    position: Float[np.ndarray, "time body 2"], rotation: Float[np.ndarray, "time body"], bodies: np.ndarray
) -> str:
    """Where bodies are at each time: x, y and angle of one after the other."""
    places = np.concatenate([lengths(position[:, bodies]), angles(rotation[:, bodies])[..., None]], -1)
    return text_of(places)
