"""What a level consists of, and a hash of it that does not depend on how its things are numbered and named.

What counts as content and what does not: docs/levels.md. Levels with the same hash have the same content,
but for the chance of 128 bits. Levels with the same content have the same hash, unless they have exact copies of a
body, at one position with one motion, that are joined alike as well: their hash may depend on how the copies are
numbered. No sampled and no handmade level has such copies. Numpy on the host.
"""

import hashlib
from typing import Any

import jax
import numpy as np

from levelproof.levelgen.identity.form import NO_ENTRY, Push, Side, World, canonical_form
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import Level
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES

VERSION = 1  # of the form; hashes of different versions never compare equal
DIGITS = 32  # of a hash, hexadecimal: 128 bits


def content_hashes(level: Level) -> list[str]:
    """A hash for each level, such as `c1:` and 32 digits. Levels start without contacts; none are looked at."""
    return [f"c{VERSION}:{hashlib.sha256(canonical_form(world)).hexdigest()[:DIGITS]}" for world in worlds(level)]


def level_id_for(content_hash: str) -> int:
    """The id of a level that no id makes: its random streams follow from its content alone."""
    return int(content_hash.partition(":")[2][:8], 16) & MAX_LEVEL_ID


def level_first(level: Level) -> Any:
    """The same on the host, with the level axis first."""
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), -1, 0), level)


def worlds(level: Level) -> list[World]:
    """The content of each level. Its active bodies are numbered one after another."""
    levels = level_first(level)
    model = levels.model
    count, polygons = model.n_vertices.shape
    # (level, thing, word)
    matter, sides, gravity = _body_rows(levels), _joint_rows(levels), _words(model.gravity)
    rings, radii = _words(model.vertices.reshape(count, polygons, 2 * MAX_VERTICES)), _words(model.radius[..., None])
    pushes = _columns(model.thruster_position, model.thruster_rotation, model.thruster_power)
    # (level, thing)
    entries = np.where(_runs(levels) & ~levels.motor_auto, levels.motor_binding, NO_ENTRY)
    joints, thrusters = acting_joints(levels), acting_thrusters(levels)

    def world(i: int) -> World:
        bodies = np.flatnonzero(model.active[i]).tolist()
        number = {body: k for k, body in enumerate(bodies)}

        def shape(body: int) -> bytes:
            if body >= polygons:
                return radii[i, body - polygons].tobytes()
            return _ring(rings[i, body, : 2 * model.n_vertices[i, body]].tobytes())

        def side(j: int, way: int) -> Side:
            first, second = (number[int(end[i, j])] for end in (model.joint_a, model.joint_b)[::way])
            row, direction = sides[way]
            return Side(first, second, row[i, j].tobytes(), int(direction[i, j]), int(entries[i, j]))

        def push(t: int) -> Push:
            body, entry = int(model.thruster_body[i, t]), int(levels.thruster_binding[i, t])
            return Push(number[body], pushes[i, t].tobytes(), entry)

        return World(
            gravity[i].tobytes(),
            [matter[i, body].tobytes() + shape(body) for body in bodies],
            [(side(j, 1), side(j, -1)) for j in np.flatnonzero(joints[i]).tolist()],
            [push(t) for t in np.flatnonzero(thrusters[i]).tolist()],
            _apart(model.collides[i], model.inverse_mass[i] != 0, bodies),
        )

    return list(map(world, range(count)))


def _ring(vertices: bytes) -> bytes:
    """Vertices of 8 bytes in a circle: which of them is the first is a number only."""
    return min((vertices[k:] + vertices[:k] for k in range(0, len(vertices), 8)), default=vertices)


def kinds(levels: Any) -> np.ndarray:
    """(level, body): 0 scenery, 1 polygon, 2 circle."""
    number = np.arange(levels.role.shape[1])
    kind = np.where(number < FIXED_POLYGONS, 0, np.where(number < levels.model.n_vertices.shape[1], 1, 2))
    return np.broadcast_to(kind, levels.role.shape)


def _body_rows(levels: Any) -> np.ndarray:
    """Everything of a body but its shape. Which of the four scenery polygons it is, is a number only."""
    model, state = levels.model, levels.state
    matter = model.inverse_mass, model.inverse_inertia, model.friction, model.restitution
    motion = state.position, state.rotation, state.velocity, state.angular_velocity
    return _columns(kinds(levels), levels.role, model.collision_mode, *matter, *motion)


def acting_joints(levels: Any) -> np.ndarray:
    """Joints that the engine does not skip: both bodies are there, and at least one of them can move."""
    model = levels.model
    moves = _of_body(model.inverse_mass != 0, model.joint_a) | _of_body(model.inverse_mass != 0, model.joint_b)
    return model.joint_active & _of_body(model.active, model.joint_a) & _of_body(model.active, model.joint_b) & moves


def acting_thrusters(levels: Any) -> np.ndarray:
    """Thrusters with power on a body that is there."""
    model = levels.model
    return model.thruster_active & _of_body(model.active, model.thruster_body) & (model.thruster_power != 0)


def _of_body(flag: np.ndarray, body: np.ndarray) -> np.ndarray:
    """A flag of the bodies with these numbers, False where there is none."""
    inside = (body >= 0) & (body < flag.shape[1])
    return inside & np.take_along_axis(flag, np.where(inside, body, 0), 1)


def _runs(levels: Any) -> np.ndarray:
    model = levels.model
    return model.motor_on & ~model.joint_fixed & (model.motor_power != 0)


def _joint_rows(levels: Any) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Rows and directions of joints as seen from a (1) and from b (-1). What has no effect there is 0.

    Seen from b, angles and impulses have the other sign, and a motor turns against its entry. Where no limit weakens
    the motor, a speed below 0 is a speed above 0 in the other direction.
    """
    model, state, runs = levels.model, levels.state, _runs(levels)
    limited = model.joint_limited & ~model.joint_fixed
    auto, either = runs & levels.motor_auto, runs & ~limited
    rest = np.where(limited | model.joint_fixed, model.joint_rotation, 0)
    low, high = (np.where(limited, x, 0) for x in (model.joint_min, model.joint_max))
    speed = np.where(runs, np.where(either, np.abs(model.motor_speed), model.motor_speed), 0)
    power = np.where(runs, model.motor_power, 0)
    forward = np.where(either, np.sign(model.motor_speed), runs).astype(np.int32)
    anchors, limits = (model.joint_anchor_a, model.joint_anchor_b), (low, high)
    sides = {}
    for way in (1, -1):
        angles = [way * x for x in (rest, *limits[::way], state.joint_impulse, state.joint_angular_impulse)]
        kinds = model.joint_fixed, limited, runs, auto, np.where(auto, way * forward, 0)
        row = _columns(*anchors[::way], *angles, speed, power, *kinds)
        sides[way] = row, np.where(auto, 0, way * forward)
    return sides


def _apart(collides: np.ndarray, moves: np.ndarray, bodies: list[int]) -> list[tuple[int, int]]:
    """Pairs that do not collide, as indices into `bodies`. Two that cannot move never push each other."""
    able = moves[bodies]
    kept = ~collides[np.ix_(bodies, bodies)] & (able | able[:, None])
    one, other = np.nonzero(np.triu(kept, 1))
    return list(zip(one.tolist(), other.tolist(), strict=True))


def _columns(*values: np.ndarray) -> np.ndarray:
    """Side by side as words, (level, thing, word)."""
    return np.concatenate([_words(x if x.ndim == 3 else x[..., None]) for x in values], -1)


def _words(values: np.ndarray) -> np.ndarray:
    """The exact bits of numbers, little end first; a zero has no sign."""
    if values.dtype.kind == "f":
        return np.ascontiguousarray(values.astype("<f4") + np.float32(0)).view("<u4")
    return np.ascontiguousarray(values.astype("<i4")).view("<u4")
