"""A level's content and its hash, which do not depend on how bodies, joints and thrusters are numbered.

docs/levels.md says what counts as content. Levels with the same hash have the same content, except for collisions of
the 128-bit hash. Levels with the same content have the same hash, unless they contain exact copies of a body (at one
position, with one motion) that are also joined alike: then the hash may depend on how the copies are numbered. No
sampled or handmade level contains such copies. Numpy on the host.
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
    """Hash each level: `c1:` and 32 digits. Contacts are ignored; levels start without any."""
    return [f"c{VERSION}:{hashlib.sha256(canonical_form(world)).hexdigest()[:DIGITS]}" for world in worlds(level)]


def level_id_for(content_hash: str) -> int:
    """Derive an id from the content of a level that was not sampled; its random streams follow from it."""
    return int(content_hash.partition(":")[2][:8], 16) & MAX_LEVEL_ID


def level_first(level: Level) -> Any:
    """Copy levels to the host with the level axis first."""
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), -1, 0), level)


def worlds(level: Level) -> list[World]:
    """Return the content of each level. Its active bodies are numbered consecutively."""
    levels = level_first(level)
    model = levels.model
    count, polygons = model.n_vertices.shape
    # (level, row, word)
    matter, sides, gravity = _body_rows(levels), _joint_rows(levels), _words(model.gravity)
    rings, radii = _words(model.vertices.reshape(count, polygons, 2 * MAX_VERTICES)), _words(model.radius[..., None])
    pushes = _columns(model.thruster_position, model.thruster_rotation, model.thruster_power)
    # (level, row)
    entries = np.where(_motor_runs(levels) & ~levels.motor_auto, levels.motor_binding, NO_ENTRY)
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
    """Rotate cyclic vertices of 8 bytes to the smallest string: which comes first is not content."""
    return min((vertices[k:] + vertices[:k] for k in range(0, len(vertices), 8)), default=vertices)


def body_kinds(levels: Any) -> np.ndarray:
    """Return (level, body): 0 scenery, 1 polygon, 2 circle."""
    body = np.arange(levels.role.shape[1])
    kind = np.where(body < FIXED_POLYGONS, 0, np.where(body < levels.model.n_vertices.shape[1], 1, 2))
    return np.broadcast_to(kind, levels.role.shape)


def _body_rows(levels: Any) -> np.ndarray:
    """Return all content of a body except its shape. The index among the four scenery polygons is not content."""
    model, state = levels.model, levels.state
    matter = model.inverse_mass, model.inverse_inertia, model.friction, model.restitution
    motion = state.position, state.rotation, state.velocity, state.angular_velocity
    return _columns(body_kinds(levels), levels.role, model.collision_mode, *matter, *motion)


def acting_joints(levels: Any) -> np.ndarray:
    """Find joints that the engine does not skip: both bodies are active, and at least one can move."""
    model = levels.model
    moves = _of_body(model.inverse_mass != 0, model.joint_a) | _of_body(model.inverse_mass != 0, model.joint_b)
    return model.joint_active & _of_body(model.active, model.joint_a) & _of_body(model.active, model.joint_b) & moves


def acting_thrusters(levels: Any) -> np.ndarray:
    """Find thrusters with power on an active body."""
    model = levels.model
    return model.thruster_active & _of_body(model.active, model.thruster_body) & (model.thruster_power != 0)


def _of_body(flag: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Return a body flag at body indices, False for an invalid index."""
    inside = (body >= 0) & (body < flag.shape[1])
    return inside & np.take_along_axis(flag, np.where(inside, body, 0), 1)


def _motor_runs(levels: Any) -> np.ndarray:
    """Find joints whose motor can turn them."""
    model = levels.model
    return model.motor_on & ~model.joint_fixed & (model.motor_power != 0)


def _joint_rows(levels: Any) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return rows and directions of joints as seen from a (key 1) and from b (key -1); 0 for what has no effect.

    Seen from b, angles and impulses have the opposite sign, and a motor turns against its entry. Without a limit that
    weakens the motor, a negative speed equals a positive one in the opposite direction.
    """
    model, state, runs = levels.model, levels.state, _motor_runs(levels)
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
    """Find pairs that do not collide, as indices into `bodies`; pairs of immovable bodies never do and are left out."""
    movable = moves[bodies]
    kept = ~collides[np.ix_(bodies, bodies)] & (movable | movable[:, None])
    one, other = np.nonzero(np.triu(kept, 1))
    return list(zip(one.tolist(), other.tolist(), strict=True))


def _columns(*values: np.ndarray) -> np.ndarray:
    """Join values side by side as 32-bit words, (level, row, word)."""
    return np.concatenate([_words(x if x.ndim == 3 else x[..., None]) for x in values], -1)


def _words(values: np.ndarray) -> np.ndarray:
    """Return the exact bits of numbers, little-endian; -0 becomes 0."""
    if values.dtype.kind == "f":
        return np.ascontiguousarray(values.astype("<f4") + np.float32(0)).view("<u4")
    return np.ascontiguousarray(values.astype("<i4")).view("<u4")
