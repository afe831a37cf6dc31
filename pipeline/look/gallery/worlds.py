"""Compact encoding of levels and witnesses for a gallery: 16-bit integers, which `site/draw.js` decodes.

A world is a list of integers: the counts of bodies, immovable bodies, joints and thrusters, then each of them.
Immovable bodies come first, so that they are drawn behind. Lengths are in units of LENGTH, angles in units of ANGLE.
"""

from base64 import b64encode

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from levelproof.levelgen.level import Level
from levelproof.physics.types import MAX_VERTICES

LENGTH = 1 / 2000  # m; 16 bits reach 16.4 m to either side, and the engine keeps bodies within 15 m
ANGLE = 1 / 10_000  # rad; 16 bits reach beyond -pi to pi
MAX_INT16 = 2**15 - 1


def lengths(values: ArrayLike) -> Int[np.ndarray, "..."]:
    """Convert metres to integer multiples of LENGTH, clipped to 16 bits."""
    return np.clip(np.nan_to_num(np.asarray(values) / LENGTH), -MAX_INT16, MAX_INT16).round().astype(np.int16)


def angles(values: ArrayLike) -> Int[np.ndarray, "..."]:
    """Convert radians to integer multiples of ANGLE, within -pi to pi."""
    turn, known = 2 * np.pi, np.nan_to_num(np.asarray(values, np.float64))
    within = known - turn * np.round(known / turn)
    return (within / ANGLE).round().astype(np.int16)


def encode_array(numbers: np.ndarray) -> str:
    """Encode numbers as little-endian bytes in base64."""
    return b64encode(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes()).decode()


def drawn_bodies(level: Level) -> tuple[Int[np.ndarray, " body"], int]:
    """Indices of ONE level's bodies (no lane axis) in drawing order, and the number of immovable ones."""
    present = np.flatnonzero(level.model.active)
    moves = np.asarray(level.model.inverse_mass)[present] != 0
    return present[np.argsort(moves, kind="stable")], int((~moves).sum())


def world_of(level: Level) -> str:
    """Encode the initial world of ONE level (no lane axis)."""
    model, (bodies, still) = level.model, drawn_bodies(level)
    drawn = np.full(level.size.bodies, len(bodies))  # index in drawing order
    drawn[bodies] = np.arange(len(bodies))
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
        kind = int(fixed) + 2 * int(motor) + 4 * int(auto) + 8 * int(model.motor_speed[joint] < 0)
        numbers += [drawn[model.joint_a[joint]], *anchors[joint], kind, level.motor_binding[joint]]
    positions, turns = lengths(model.thruster_position), angles(model.thruster_rotation)
    for thruster in thrusters:
        body, binding = drawn[model.thruster_body[thruster]], level.thruster_binding[thruster]
        numbers += [body, *positions[thruster], turns[thruster], binding]
    return encode_array(np.array(numbers, np.int16))


def states_of(
    position: Float[np.ndarray, "time body 2"], rotation: Float[np.ndarray, "time body"], bodies: np.ndarray
) -> str:
    """Encode bodies at each time as x, y, angle of one body after the other."""
    places = np.concatenate([lengths(position[:, bodies]), angles(rotation[:, bodies])[..., None]], -1)
    return encode_array(places)
