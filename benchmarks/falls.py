"""Levels in which green can only fall onto red: an exact argument about handmade levels that nothing solves.

Green is a circle without a joint, at rest, and nothing else moves. Its thrusters push through its centre, so that it
does not turn, and lift less than it weighs: until it touches something its position stays in a box that is known for
every physics step, whatever the actions. Where that box meets nothing but red before it is below the top of a red
floor, red is the first thing that green touches, and ends the episode. Too few random levels are like this for a label
to rest on it (docs/tried/labels.md).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.task.rules import TaskParams

MARGIN = 0.02  # m; more than what contacts overlap before they count, and than all rounding
LONGEST = 512  # physics steps


@dataclass(frozen=True)
class Fall:
    """What every sequence of actions has in common."""

    weight: float  # N
    lift: float  # N, of all thrusters at most
    env_steps: int  # after which green has touched red at the latest
    reach: tuple[float, float]  # m, of what green covers until then, from left to right


def fall(level: Level, rules: TaskParams) -> Fall | None:
    """Why green touches red before all else; None where this argument does not hold.

    Args:
        level: one lane, numpy arrays.
        rules: of the task, with the engine's constants.
    """
    m, physics = level.model, rules.physics
    role = np.where(m.active[:, 0], level.role[:, 0], Role.PLAIN)
    moves = m.active[:, 0] & (m.inverse_mass[:, 0] + m.inverse_inertia[:, 0] > 0)
    green = np.flatnonzero(role == Role.GREEN)
    if len(green) != 1 or not np.array_equal(np.flatnonzero(moves), green) or green[0] < m.size.polygons:
        return None
    body = int(green[0])
    held = ((m.joint_a == body) | (m.joint_b == body)) & m.joint_active
    state = level.state
    if held.any() or state.velocity[body].any() or state.angular_velocity[body].any():
        return None
    mass, radius = 1 / float(m.inverse_mass[body, 0]), float(m.radius[body - m.size.polygons, 0])
    seconds = LONGEST * physics.dt
    least, most = forces(level, rules, body, seconds)
    least, most = least / mass + m.gravity[:, 0], most / mass + m.gravity[:, 0]
    if most[1] >= 0:
        return None

    start, covered = state.position[body, :, 0], boxes(level)
    floor = covered[0]
    step = np.arange(1, LONGEST + 1)
    way = physics.dt**2 * step * (step + 1) / 2  # of semi-implicit Euler, for each m/s^2
    on_floor = start[1] + most[1] * way - radius < floor[1, 1] - MARGIN
    if role[0] != Role.RED or not on_floor.any():
        return None
    last = int(np.argmax(on_floor))
    left, right = start[0] + min(least[0], 0) * way[last] - radius, start[0] + max(most[0], 0) * way[last] + radius
    swept = np.array([[left - MARGIN, right + MARGIN], [-np.inf, start[1] + radius + MARGIN]])
    for other, box in enumerate(covered):
        meets = (box[:, 0] <= swept[:, 1]).all() and (swept[:, 0] <= box[:, 1]).all()
        if m.active[other, 0] and other != body and role[other] != Role.RED and meets:
            return None
    if not (floor[0, 0] <= left and right <= floor[0, 1]):
        return None
    env_steps = -(-(last + 1) // rules.frame_skip) + 1  # contacts are looked for before bodies move
    lift = mass * (most[1] - float(m.gravity[1, 0]))
    return Fall(-mass * float(m.gravity[1, 0]), lift, env_steps, (left, right))


def forces(
    level: Level, rules: TaskParams, body: int, seconds: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The least and the most that the thrusters push, N, in each direction; with what the body may turn by then."""
    m = level.model
    on = m.thruster_active[:, 0] & (m.thruster_body[:, 0] == body)
    strength = (m.thruster_power[:, 0] * rules.physics.thruster_power)[on]
    angle, at = m.thruster_rotation[on, 0] + level.state.rotation[body, 0], m.thruster_position[on, :, 0]
    towards = np.stack([np.cos(angle), np.sin(angle)])
    torque = np.abs(at[:, 0] * towards[1] - at[:, 1] * towards[0]) * strength
    turned = float(torque.sum() * m.inverse_inertia[body, 0]) * seconds**2
    push, doubt = towards * strength, strength.sum() * (turned + 1e-4)
    return np.minimum(push, 0).sum(1) - doubt, np.maximum(push, 0).sum(1) + doubt


def boxes(level: Level) -> Float[np.ndarray, "body 2 2"]:
    """What each body covers at the start, m: from and to, in each direction."""
    m, state = level.model, level.state
    polygons = m.size.polygons
    turned, centre = state.rotation[:polygons, 0], state.position[..., 0]
    x, y = m.vertices[..., 0, 0], m.vertices[..., 1, 0]
    cos, sin = np.cos(turned)[:, None], np.sin(turned)[:, None]
    corner = np.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)
    there = np.arange(corner.shape[1]) < m.n_vertices[:, :1]
    least = np.where(there[..., None], corner, np.inf).min(1)
    most = np.where(there[..., None], corner, -np.inf).max(1)
    radius = np.broadcast_to(m.radius[:, :1], (len(m.radius), 2))
    from_, to = np.concatenate([least, -radius]), np.concatenate([most, radius])
    return np.stack([centre + from_, centre + to], axis=-1)
