"""The symbolic-flat observation, one row per feature.

Rows, in this order: polygons (without walls and ceiling), circles, joints, thrusters, gravity. Features of inactive
entities (bodies, joints, thrusters) are zero. Most rows are constant within a level (`level_features`); only positions
and velocities of movable bodies change (`state_features`, at the rows `dynamic_features`), which a network's first
layer can exploit.
Facts: `kinetix.render.renderer_symbolic_flat` and `renderer_symbolic_common` 3.0.2.
"""

from functools import cache
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, Level, Role
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, Size, State

LIMIT = 10.0  # features are clipped to +-LIMIT
GRAVITY_UNIT = 10.0  # m/s^2
SPIN_UNIT = 10.0  # rad/s; angular velocity w is observed as tanh(w / SPIN_UNIT)
NO_VERTEX = -1.0  # coordinates of a triangle's fourth vertex
UNSEEN_WALLS = range(1, FIXED_POLYGONS)  # left wall, right wall, ceiling
AT_ONCE = 512  # observations that `join_features` writes at once, so that they stay in the processor's cache

# Rows of a body: position 0-1, velocity 2-3, inverse mass 4, inverse inertia 5, density 6, spin 7, role 8-11,
# sine 12 and cosine 13 of the rotation, friction 14, restitution 15, then its shape.
DYNAMIC_ROWS = (0, 1, 2, 3, 7, 12, 13)
BODY_ROWS = 16
POLYGON_ROWS = BODY_ROWS + 1 + 2 * MAX_VERTICES + 1  # 0 for "no circle", vertices, whether a triangle
CIRCLE_ROWS = BODY_ROWS + 2  # radius, 1 for "circle"
JOINT_ROWS = 18 + MOTOR_BINDINGS  # plus two one-hot bodies
THRUSTER_ROWS = 6 + THRUSTER_BINDINGS  # plus a one-hot body


def feature_count(size: Size) -> int:
    """Return the number of rows of the observation: 140 for size s."""
    return sum(count * rows for count, rows in tables_of(size)) + 1


def tables_of(size: Size) -> tuple[tuple[int, int], ...]:
    """Return (count, rows of each) for polygons, circles, joints and thrusters, in the observation's order."""
    return (
        (size.polygons - len(UNSEEN_WALLS), POLYGON_ROWS),
        (size.circles, CIRCLE_ROWS),
        (size.joints, JOINT_ROWS + 2 * size.bodies),
        (size.thrusters, THRUSTER_ROWS + size.bodies),
    )


@cache
def dynamic_features(size: Size) -> Int[np.ndarray, "dynamic"]:
    """Return the rows of the observation that can change within a level, ascending. The floor never moves."""
    polygons = POLYGON_ROWS * (1 + np.arange(size.polygons - FIXED_POLYGONS))
    circles = POLYGON_ROWS * (1 + len(polygons)) + CIRCLE_ROWS * np.arange(size.circles)
    index = (np.concatenate([polygons, circles])[:, None] + np.array(DYNAMIC_ROWS)).reshape(-1)
    index.setflags(write=False)
    return index


def symbolic_flat(
    level: Level, state: State, constant: Float[Array, "feature lane"] | None = None
) -> Float[Array, "feature lane"]:
    """Observe a state: all features, clipped to +-LIMIT, NaN as 0.

    `constant` is `level_features(level)`, if the caller has computed it (once per rollout instead of per step).
    """
    constant = level_features(level) if constant is None else constant
    moving = state_features(level, state)
    lanes = max(constant.shape[-1], moving.shape[-1])
    constant, moving = (jnp.broadcast_to(x, (len(x), lanes)) for x in (constant, moving))
    # Interleave the two run by run by concatenating slices: an indexed write would be a slow scatter.
    pieces, used = [], 0
    for start, stop, is_dynamic in _runs(level.size):
        pieces.append(moving[used : used + stop - start] if is_dynamic else constant[start:stop])
        used += (stop - start) * is_dynamic
    return jnp.concatenate(pieces)


def join_features(
    size: Size,
    constant: Float[np.ndarray, "level feature"],
    moving: Float[np.ndarray, "row dynamic"],
    row_level: Int[np.ndarray, " row"],
) -> Float[np.ndarray, "row feature"]:
    """Join `level_features` and `state_features`, both with features last, into observations.

    Outside of XLA, because copying a level's features to each of its rows takes a third of the time that XLA takes to
    concatenate the pieces of `symbolic_flat`, feature by feature.

    Args:
        size: size of the levels.
        constant: features of the levels.
        moving: features of the states.
        row_level: the level of each state.
    """
    rows, dynamic = np.empty((len(moving), constant.shape[1]), np.float32), dynamic_features(size)
    for first in range(0, len(rows), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        np.take(constant, row_level[some], 0, rows[some], mode="clip")  # mode "raise" would copy the result once more
        rows[some, dynamic] = moving[some]
    return rows


@cache
def _runs(size: Size) -> tuple[tuple[int, int, bool], ...]:
    """Return (first row, row after the last, whether dynamic) for each run of constant or dynamic rows."""
    is_dynamic = np.isin(np.arange(feature_count(size)), dynamic_features(size))
    edges = [0, *(np.flatnonzero(np.diff(is_dynamic)) + 1).tolist(), len(is_dynamic)]
    return tuple((start, stop, bool(is_dynamic[start])) for start, stop in pairwise(edges))


def state_features(level: Level, state: State) -> Float[Array, "dynamic lane"]:
    """Return the rows `dynamic_features`: position, velocity, spin and heading of every movable body."""
    at = slice(FIXED_POLYGONS, None)
    return _side_by_side(motion_rows(state, at), level.model.active[at])


def motion_rows(state: State, at: slice) -> list[Array]:
    """Return the DYNAMIC_ROWS of some bodies."""
    spin, rotation = jnp.tanh(state.angular_velocity[at] / SPIN_UNIT), state.rotation[at]
    return [*_split(state.position[at]), *_split(state.velocity[at]), spin, jnp.sin(rotation), jnp.cos(rotation)]


def level_features(level: Level) -> Float[Array, "feature lane"]:
    """Return all features that are constant within a level; zeros at the rows `dynamic_features`."""
    model, size = level.model, level.size
    floor, movable = slice(0, 1), slice(FIXED_POLYGONS, size.polygons)
    parts = [
        _side_by_side(body_rows(level, floor) + polygon_rows(model, floor), model.active[floor]),
        _side_by_side(body_rows(level, movable, constant=True) + polygon_rows(model, movable), model.active[movable]),
    ]
    if size.circles:
        circles = slice(size.polygons, size.bodies)
        shape = [model.radius, jnp.ones_like(model.radius)]
        parts.append(_side_by_side(body_rows(level, circles, constant=True) + shape, model.active[circles]))
    one_hot = lambda body: _one_hot(body, size.bodies)
    if size.joints:
        ends = one_hot(model.joint_b) + one_hot(model.joint_a)
        parts.append(_side_by_side(joint_rows(level) + ends, model.joint_active))
    if size.thrusters:
        parts.append(_side_by_side(thruster_rows(level) + one_hot(model.thruster_body), model.thruster_active))
    parts.append(_tidy(model.gravity[1:] / GRAVITY_UNIT))
    lanes = max(part.shape[-1] for part in parts)
    return jnp.concatenate([jnp.broadcast_to(part, (len(part), lanes)) for part in parts])


def body_rows(level: Level, at: slice, constant: bool = False) -> list[Array]:
    """Return the rows of some bodies in `level.state`, each [body, lane]; if `constant`, dynamic ones are zero."""
    model = level.model
    *motion, spin, sine, cosine = motion_rows(level.state, at)
    if constant:
        *motion, spin, sine, cosine = [jnp.zeros_like(model.friction[at])] * len(DYNAMIC_ROWS)
    mass = [model.inverse_mass[at], model.inverse_inertia[at], level.density[at]]
    surface = [model.friction[at], model.restitution[at]]
    return [*motion, *mass, spin, *_one_hot(level.role[at], len(Role)), sine, cosine, *surface]


def polygon_rows(model: Model, at: slice) -> list[Array]:
    """Return the rows of polygons that follow a body's rows."""
    count, vertices = model.n_vertices[at], model.vertices[at]
    corners = [jnp.where(k < count[:, None], vertices[:, k], NO_VERTEX) for k in range(MAX_VERTICES)]
    triangle = (count <= 3).astype(jnp.float32)
    return [jnp.zeros_like(triangle), *(row for corner in corners for row in _split(corner)), triangle]


def joint_rows(level: Level, seen_from_a: bool = False) -> list[Array]:
    """Return the rows of joints as seen from one body, whose anchor comes first."""
    model = level.model
    anchors = [model.joint_anchor_b, model.joint_anchor_a]
    near, far = anchors[::-1] if seen_from_a else anchors
    limit = lambda x: x * model.joint_limited
    motor = [
        model.motor_speed,
        model.motor_power,
        model.motor_on,
        model.joint_limited,
        *_one_hot(level.motor_binding, MOTOR_BINDINGS),
        *(limit(part(angle)) for angle in (model.joint_min, model.joint_max) for part in (jnp.sin, jnp.cos)),
        *(limit(angle - model.joint_rotation) for angle in (model.joint_min, model.joint_max)),
    ]
    return [
        model.joint_active,
        model.joint_fixed,
        *_split(near),
        *_split(far),
        jnp.sin(model.joint_rotation),
        jnp.cos(model.joint_rotation),
        *(jnp.where(model.joint_fixed, 0.0, row) for row in motor),
    ]


def thruster_rows(level: Level) -> list[Array]:
    model = level.model
    return [
        model.thruster_active,
        *_split(model.thruster_position),
        *_one_hot(level.thruster_binding, THRUSTER_BINDINGS),
        jnp.sin(model.thruster_rotation),
        jnp.cos(model.thruster_rotation),
        model.thruster_power,
    ]


def _split(xy: Float[Array, "entity 2 lane"]) -> list[Array]:
    return [xy[:, 0], xy[:, 1]]


def _one_hot(index: Int[Array, "entity lane"], count: int) -> list[Array]:
    return [index == k for k in range(count)]


def _side_by_side(rows: list[Array], active: Array) -> Float[Array, "feature lane"]:
    """Flatten [row, entity, lane] to [entity * row, lane]; inactive entities become zero."""
    rows = jnp.broadcast_arrays(*(row.astype(jnp.float32) for row in rows))
    stacked = jnp.where(active[:, None], jnp.stack(rows, axis=1), 0.0)
    return _tidy(stacked).reshape(-1, stacked.shape[-1])


def _tidy(features: Array) -> Array:
    return jnp.where(jnp.isnan(features), 0.0, jnp.clip(features, -LIMIT, LIMIT))
