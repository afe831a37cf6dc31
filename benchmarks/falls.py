"""An exact argument that handmade levels cannot be solved: green can only fall onto red.

Green is a circle without a joint, at rest, and nothing else moves. Its thrusters push through its centre, so that it
does not turn, and lift less than its weight. Until green touches something, its position therefore stays in a box that
is known for every physics step, whatever the actions. If that box meets nothing but red before it sinks below the top
of a red floor, green touches red first, which ends the episode. Too few random levels are like this to justify a label
(docs/tried/labels.md).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.task.rules import TaskParams

MARGIN = 0.02  # m; exceeds both the overlap at which contacts start to count and all rounding
LONGEST = 512  # physics steps


@dataclass(frozen=True)
class Fall:
    """Facts that hold for every sequence of actions."""

    weight: float  # N
    lift: float  # N, upper bound for all thrusters
    env_steps: int  # upper bound, until green touches red
    reach: tuple[float, float]  # m, leftmost and rightmost point that green may cover until then


def fall(level: Level, rules: TaskParams) -> Fall | None:
    """Prove that green touches red first; return None if the argument does not hold.

    Args:
        level: one lane, numpy arrays.
        rules: the task's rules, with the engine's constants.
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
    low, high = forces(level, rules, body, seconds)
    low, high = low / mass + m.gravity[:, 0], high / mass + m.gravity[:, 0]
    if high[1] >= 0:
        return None

    start, covered = state.position[body, :, 0], boxes(level)
    floor = covered[0]
    step = np.arange(1, LONGEST + 1)
    way = physics.dt**2 * step * (step + 1) / 2  # s^2: distance under 1 m/s^2, by semi-implicit Euler
    on_floor = start[1] + high[1] * way - radius < floor[1, 1] - MARGIN
    if role[0] != Role.RED or not on_floor.any():
        return None
    last = int(np.argmax(on_floor))
    left, right = start[0] + min(low[0], 0) * way[last] - radius, start[0] + max(high[0], 0) * way[last] + radius
    swept = np.array([[left - MARGIN, right + MARGIN], [-np.inf, start[1] + radius + MARGIN]])
    for other, box in enumerate(covered):
        meets = (box[:, 0] <= swept[:, 1]).all() and (swept[:, 0] <= box[:, 1]).all()
        if m.active[other, 0] and other != body and role[other] != Role.RED and meets:
            return None
    if not (floor[0, 0] <= left and right <= floor[0, 1]):
        return None
    env_steps = -(-(last + 1) // rules.frame_skip) + 1  # contacts are detected before bodies move
    lift = mass * (high[1] - float(m.gravity[1, 0]))
    return Fall(-mass * float(m.gravity[1, 0]), lift, env_steps, (left, right))


def forces(
    level: Level, rules: TaskParams, body: int, seconds: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Bound the thrusters' total push from below and above, N per axis, allowing for the body's rotation by then."""
    m = level.model
    on = m.thruster_active[:, 0] & (m.thruster_body[:, 0] == body)
    strength = (m.thruster_power[:, 0] * rules.physics.thruster_power)[on]
    angle, point = m.thruster_rotation[on, 0] + level.state.rotation[body, 0], m.thruster_position[on, :, 0]
    towards = np.stack([np.cos(angle), np.sin(angle)])
    torque = np.abs(point[:, 0] * towards[1] - point[:, 1] * towards[0]) * strength
    turned = float(torque.sum() * m.inverse_inertia[body, 0]) * seconds**2
    push, doubt = towards * strength, strength.sum() * (turned + 1e-4)
    return np.minimum(push, 0).sum(1) - doubt, np.maximum(push, 0).sum(1) + doubt


def boxes(level: Level) -> Float[np.ndarray, "body 2 2"]:
    """Return the bounding box of each body at the start, m: lower and upper end of each axis."""
    m, state = level.model, level.state
    polygons = m.size.polygons
    turned, centre = state.rotation[:polygons, 0], state.position[..., 0]
    x, y = m.vertices[..., 0, 0], m.vertices[..., 1, 0]
    cos, sin = np.cos(turned)[:, None], np.sin(turned)[:, None]
    corner = np.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)
    used = np.arange(corner.shape[1]) < m.n_vertices[:, :1]
    low = np.where(used[..., None], corner, np.inf).min(1)
    high = np.where(used[..., None], corner, -np.inf).max(1)
    radius = np.broadcast_to(m.radius[:, :1], (len(m.radius), 2))
    low, high = np.concatenate([low, -radius]), np.concatenate([high, radius])
    return np.stack([centre + low, centre + high], axis=-1)
