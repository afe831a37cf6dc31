"""Hand-made levels that random play does not solve, all of one size, so that one kernel is compiled."""

import dataclasses

import jax
import numpy as np

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.sampling.scenery import FLOOR_TOP, empty_level
from levelproof.physics.types import FIXED_POLYGONS, Size

SIZE = Size(polygons=7, circles=2, joints=1, thrusters=2)
BARS = slice(FIXED_POLYGONS, SIZE.polygons)
BALL, GOAL = SIZE.polygons, SIZE.polygons + 1
WEIGHT = 0.16 * 9.81  # N, of the ball


def switchback() -> Level:
    """A ball with a thruster to each side must fly around two red shelves to the goal above them."""
    return world(
        bars=[((1.8, 1.5), (1.8, 0.1), 0.0), ((3.2, 3.2), (1.8, 0.1), 0.0)],
        bar_role=Role.RED,
        ball=(0.6, 0.6),
        goal=(4.5, 4.2),
        angles=(np.pi / 3, 2 * np.pi / 3),
        thrust=0.9,
    )


def valley() -> Level:
    """A ball without friction must swing up to the goal from a valley; its thrusters are weaker than the slopes."""
    level = world(
        bars=[((0.6, 0.9), (2.5, 0.5), -0.7), ((4.4, 0.9), (2.5, 0.5), 0.7)],
        bar_role=Role.PLAIN,
        ball=(2.5, 0.6),
        goal=(0.4, 2.2),
        angles=(0.0, np.pi),
        thrust=0.4,
    )
    level.model.friction[:] = 0
    return level


def cannon() -> Level:
    """A ball must fly over a low red wall to a goal behind it. Its thrusters push it up and forwards, or forwards only;
    the bar that it starts from is the only ground that is not red."""
    level = world(
        bars=[((0.6, 1.2), (0.4, 0.1), 0.0), ((2.6, 0.7), (0.1, 0.3), 0.0), ((2.5, FLOOR_TOP), (2.5, 0.1), 0.0)],
        bar_role=Role.RED,
        ball=(0.6, 1.5),
        goal=(4.2, 0.9),
        angles=(np.pi / 3, 0.0),
        thrust=1.5,
    )
    level.role[FIXED_POLYGONS] = Role.PLAIN
    return level


def tower() -> Level:
    """A tower of two heavy boxes, the upper one green, with blue between it and a wall. A ball must fly over wall and
    tower and topple it from behind, at some speed. Hit from the front, green would fall off behind, out of reach."""
    boxes = [((3.2, FLOOR_TOP + 0.5), (0.2, 0.5)), ((3.2, FLOOR_TOP + 1.2), (0.25, 0.2))]
    level = world(
        bars=[*((centre, half, 0.0) for centre, half in boxes), ((1.8, FLOOR_TOP + 1.6), (0.1, 1.6), 0.0)],
        bar_role=Role.PLAIN,
        ball=(0.6, 0.6),
        goal=(2.6, FLOOR_TOP + 0.2),
        angles=(np.pi / 3, 2 * np.pi / 3),
        thrust=0.9,
    )
    for i, (_, (x, y)) in enumerate(boxes, FIXED_POLYGONS):
        mass = 8 * x * y  # kg, at 2 kg/m^2
        level.model.inverse_mass[i], level.model.inverse_inertia[i] = 1 / mass, 3 / (mass * (x * x + y * y))
    level.role[BALL], level.role[FIXED_POLYGONS + 1] = Role.PLAIN, Role.GREEN
    return level


def broken() -> Level:
    """The valley, with a ball at NaN."""
    level = valley()
    level.state.position[BALL] = np.nan
    return level


def world(*, bars, bar_role, ball, goal, angles, thrust) -> Level:
    """One level: fixed bars (centre, half sides, angle), a ball that does not turn, its two thrusters, a fixed goal."""
    level = jax.tree.map(np.array, empty_level(SIZE, 1))
    m = level.model
    m.active[:] = True
    m.active[FIXED_POLYGONS + len(bars) : SIZE.polygons] = False
    for i, (centre, (x, y), angle) in enumerate(bars, FIXED_POLYGONS):
        m.vertices[i, ..., 0] = [(x, y), (x, -y), (-x, -y), (-x, y)]
        level.state.position[i, :, 0], level.state.rotation[i] = centre, angle
    m.radius[:] = 0.2
    m.inverse_mass[BALL] = 1 / 0.16
    level.state.position[BALL, :, 0], level.state.position[GOAL, :, 0] = ball, goal
    level.role[BARS], level.role[BALL], level.role[GOAL] = bar_role, Role.GREEN, Role.BLUE
    m.thruster_active[:], m.thruster_body[:], m.thruster_power[:] = True, BALL, thrust * WEIGHT / 10
    m.thruster_rotation[:, 0] = angles
    return dataclasses.replace(level, thruster_binding=np.array([[0], [1]], np.int32))
