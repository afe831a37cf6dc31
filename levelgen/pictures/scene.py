"""Scenes: one lane of a level and its state as shapes for people, described once for every renderer.

Bodies are filled by role (grey plain, green, blue, red); bodies that cannot move are darker and hatched. A ring is
a revolute joint, a crossed square a fixed one. A motor's ring has the colour of its binding, and an arrow while it
runs; a thruster is a nozzle, with a flame while it fires. The row below shows the entries of the action that some
motor or thruster obeys, M1 to M4 for motors and T1, T2 for thrusters.

All scenes of a level have the same parts in the same order, so a film animates each part. Lengths are metres, y points
up, angles are radians.
"""

from functools import cache

import jax
import numpy as np
from jaxtyping import Int

from levelproof.levelgen.frames import in_world, turned
from levelproof.levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level, Role
from levelproof.levelgen.pictures import style
from levelproof.levelgen.pictures.shapes import Host, Part, Point, Scene, disc, line, polygon, rectangle
from levelproof.levelgen.pictures.words import Caption, caption_parts, key_parts, printable
from levelproof.physics.types import State

NOZZLE = ((0.06, 0.045), (0.06, -0.045), (-0.12, -0.1), (-0.12, 0.1))


def scene_of(
    level: Level,
    state: State,
    index: int = 0,
    action: Int[np.ndarray, "6"] | None = None,
    caption: Caption | None = None,
) -> Scene:
    """Describe lane `index` of a level in a state, under an action (one entry per binding; None: not shown)."""
    level, state = jax.tree.map(lambda x: _lane(x, index), (level, state))
    order = np.argsort(np.asarray(level.model.inverse_mass) != 0, kind="stable")  # immovable bodies lie behind
    parts = [Part(_background())]
    parts += [_body(level, state, int(body)) for body in order if level.model.active[body]]
    for thruster in np.flatnonzero(level.model.thruster_active):
        parts += _thruster(level, state, int(thruster), action)
    for joint in np.flatnonzero(level.model.joint_active):
        parts += _joint(level, state, int(joint), action)
    footer = style.FOOTER if action is not None else 0.0
    parts += [Part(_paper(footer)), *caption_parts(caption or Caption())]
    if action is not None:
        parts += key_parts(level, action)
    return Scene(tuple(parts), printable(caption.title) if caption else "", footer)


def _lane(values: Host, index: int) -> np.ndarray:
    values = np.asarray(values)
    return values[..., index if values.shape[-1] > 1 else 0]


def _point(values: Host) -> Point:
    return float(values[0]), float(values[1])


def _shade(colour: style.Colour, factor: float) -> style.Colour:
    red, green, blue = (round(part * factor) for part in colour)
    return red, green, blue


def _background() -> str:
    """Draw the walls, then the air with a grid of metres."""
    side = WORLD_SIDE
    shapes = rectangle((-style.BORDER, 0), (side + style.BORDER, side + style.BORDER), style.FIXED_PLAIN)
    shapes += rectangle((0, 0), (side, side), style.SKY)
    for metre in range(1, int(side)):
        shapes += line([(metre, 0), (metre, side)], style.GRID, 0.01) + line(
            [(0, metre), (side, metre)], style.GRID, 0.01
        )
    return shapes


def _paper(footer: float) -> str:
    """Draw the paper above and below the world, which hides bodies that leave it."""
    top, right = WORLD_SIDE + style.BORDER, WORLD_SIDE + style.BORDER
    above = rectangle((-style.BORDER, top), (right, top + style.HEADER), style.PAPER)
    return above + rectangle((-style.BORDER, -footer), (right, 0), style.PAPER) if footer else above


def _body(level: Level, state: State, body: int) -> Part:
    role, fixed = Role(int(level.role[body])), bool(level.model.inverse_mass[body] == 0)
    fill = style.ROLE_COLOUR[role]
    if fixed:
        fill = style.FIXED_PLAIN if role == Role.PLAIN else _shade(fill, 0.72)
    edge = _shade(fill, style.SHADE)
    circle = body - level.size.polygons
    if circle >= 0:
        radius = float(level.model.radius[circle])
        shapes = disc((0.0, 0.0), radius, fill, edge, fixed) + line([(0.0, 0.0), (radius, 0.0)], edge, style.EDGE)
    else:
        corners = level.model.vertices[body][: level.model.n_vertices[body]]
        shapes = polygon(corners, fill, edge, hatched=fixed)
    return Part(shapes, _point(state.position[body]), float(state.rotation[body]))


def _motor_turn(level: Level, joint: int, action: np.ndarray | None) -> int:
    """Return 1 if the motor turns body b counterclockwise relative to body a, -1 for clockwise, 0 if it is off."""
    if action is None or not level.model.motor_on[joint] or level.model.joint_fixed[joint]:
        return 0
    choice = 1 if level.motor_auto[joint] else int(action[level.motor_binding[joint]])
    forward = 1 if level.model.motor_speed[joint] >= 0 else -1
    return (0, forward, -forward)[choice]


def _joint(level: Level, state: State, joint: int, action: np.ndarray | None) -> list[Part]:
    """Draw a joint and the arrow of its motor."""
    model = level.model
    position = _point(in_world(state, int(model.joint_a[joint]), model.joint_anchor_a[joint]))
    if model.joint_fixed[joint]:
        corners = 0.065 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        cross = line(corners[::2], style.INK, style.EDGE) + line(corners[1::2], style.INK, style.EDGE)
        return [Part(polygon(corners, style.PAPER, style.INK) + cross, position)]
    motor = bool(model.motor_on[joint])
    colour = style.BINDING_COLOUR[int(level.motor_binding[joint])] if motor else style.PAPER
    ring = disc((0.0, 0.0), 0.085 if motor else 0.07, colour, style.INK)
    axle = disc((0.0, 0.0), 0.025, style.INK if level.motor_auto[joint] and motor else style.PAPER, style.INK)
    return [Part(ring + axle, position), Part(_arrow(_motor_turn(level, joint, action), colour), position)]


def _arrow(turn: int, colour: style.Colour) -> str:
    """Draw three quarters of a circle around a joint, with an arrow head at its end."""
    if not turn:
        return ""
    radius, angles = 0.17, np.linspace(0.25 * np.pi, 1.75 * np.pi, 25)
    arc = radius * np.stack([np.cos(angles), np.sin(angles)], -1)[::turn]
    outward = arc[-1] / radius
    along = turn * turned(outward, np.pi / 2)
    head = np.array([arc[-1] + 0.12 * along, arc[-1] + 0.07 * outward, arc[-1] - 0.07 * outward])
    return line(arc, style.INK, 0.035 + style.EDGE) + line(arc, colour, 0.035) + polygon(head, colour, style.INK, 0.014)


def _thruster(level: Level, state: State, thruster: int, action: np.ndarray | None) -> list[Part]:
    """Draw flame and nozzle; the nozzle opens opposite to the force, which acts along the thruster's rotation."""
    model, binding = level.model, MOTOR_BINDINGS + int(level.thruster_binding[thruster])
    body = int(model.thruster_body[thruster])
    position = _point(in_world(state, body, model.thruster_position[thruster]))
    angle = float(model.thruster_rotation[thruster] + state.rotation[body])
    flame = _flame() if action is not None and action[binding] else ""
    return [
        Part(flame, position, angle),
        Part(polygon(NOZZLE, style.BINDING_COLOUR[binding], style.INK), position, angle),
    ]


@cache
def _flame() -> str:
    def tongue(length: float, colour: style.Colour) -> str:
        half = 0.075 * (0.5 + length / 2)
        waist, tip = -0.1 - 0.16 * length, -0.1 - 0.34 * length
        return polygon([(-0.1, half), (waist, half * 0.8), (tip, 0.0), (waist, -half * 0.8), (-0.1, -half)], colour)

    return "".join(tongue(*flame) for flame in style.FLAMES)
