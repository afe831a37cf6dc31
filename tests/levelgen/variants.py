"""Other encodings of the same level, which must not change its content hash."""

import dataclasses
from functools import cache
from typing import Any

import jax
import numpy as np

from levelproof.levelgen.level import MOTOR_BINDINGS, SIZES, THRUSTER_BINDINGS, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.physics.types import FIXED_POLYGONS

# Fields with a row for each body, joint or thruster
BODY = ("active", "inverse_mass", "inverse_inertia", "friction", "restitution", "collision_mode")
MOTION = ("position", "rotation", "velocity", "angular_velocity")
JOINT = ("joint_active", "joint_a", "joint_b", "joint_anchor_a", "joint_anchor_b", "joint_fixed", "joint_rotation")
JOINT += ("joint_limited", "joint_min", "joint_max", "motor_on", "motor_speed", "motor_power")
THRUSTER = ("thruster_active", "thruster_body", "thruster_position", "thruster_rotation", "thruster_power")

COUNT = 256
IMPULSES = ("joint_impulse", "joint_angular_impulse")
BOUND = ("motor_binding", "motor_auto")


@cache
def sampled(size: str) -> Level:
    return jax.tree.map(np.asarray, sample_levels(np.arange(COUNT), SIZES[size]))


def one(size: str, number: int) -> Level:
    """Copy one sampled level, so that it may be changed in place."""
    return take(sampled(size), number)


def take(levels: Level, number: int) -> Level:
    return jax.tree.map(lambda x: np.array(x[..., number : number + 1]), levels)


def edited(level: Level, model: dict[str, Any] | None = None, state: dict[str, Any] | None = None, **own: Any) -> Level:
    model_, state_ = (
        dataclasses.replace(level.model, **(model or {})),
        dataclasses.replace(level.state, **(state or {})),
    )
    return dataclasses.replace(level, model=model_, state=state_, **own)


def renumbered(level: Level, rng: np.random.Generator) -> Level:
    """Permute scenery, movable polygons, circles, joints, thrusters and the vertices of each polygon."""
    size, movable = level.size, rng.permutation(np.arange(FIXED_POLYGONS, level.size.polygons))
    circles = rng.permutation(size.circles)
    bodies = np.concatenate([rng.permutation(FIXED_POLYGONS), movable, circles + size.polygons])
    joints, thrusters = rng.permutation(size.joints), rng.permutation(size.thrusters)
    place = np.argsort(bodies)
    model = {name: getattr(level.model, name)[bodies] for name in BODY}
    model |= {name: getattr(level.model, name)[joints] for name in JOINT}
    model |= {name: getattr(level.model, name)[thrusters] for name in THRUSTER}
    model |= {name: place[model[name]].astype(np.int32) for name in ("joint_a", "joint_b", "thruster_body")}
    model |= {name: getattr(level.model, name)[bodies[: size.polygons]] for name in ("vertices", "n_vertices")}
    for polygon, count in enumerate(model["n_vertices"][:, 0]):
        ring = model["vertices"][polygon, :count]
        model["vertices"][polygon, :count] = np.roll(ring, rng.integers(4), 0)
    model |= {"radius": level.model.radius[circles], "collides": level.model.collides[bodies][:, bodies]}
    state = {name: getattr(level.state, name)[bodies] for name in MOTION}
    state |= {name: getattr(level.state, name)[joints] for name in IMPULSES}
    own = {name: getattr(level, name)[joints] for name in BOUND}
    own |= {name: getattr(level, name)[bodies] for name in ("role", "density")}
    return edited(level, model, state, thruster_binding=level.thruster_binding[thrusters], **own)


def weakened(level: Level) -> np.ndarray:
    """Find (joint, level) motors that limits weaken; for these, the engine uses the sign of the control."""
    return level.model.motor_on & level.model.joint_limited & ~level.model.joint_fixed


def turned(level: Level, rng: np.random.Generator) -> Level:
    """Exchange sides a and b of some joints, keeping what their motors do."""
    swap = (rng.random(level.motor_binding.shape) < 0.5) & ~weakened(level)
    return edited(swapped(level, swap), {"motor_speed": np.where(swap, -1, 1) * level.model.motor_speed})


def swapped(level: Level, swap: np.ndarray) -> Level:
    """Exchange sides, which negates every angle; motors then run the other way."""
    m, wide, way = level.model, swap[:, None], np.where(swap, np.float32(-1), np.float32(1))
    model = {
        "joint_a": np.where(swap, m.joint_b, m.joint_a),
        "joint_b": np.where(swap, m.joint_a, m.joint_b),
        "joint_anchor_a": np.where(wide, m.joint_anchor_b, m.joint_anchor_a),
        "joint_anchor_b": np.where(wide, m.joint_anchor_a, m.joint_anchor_b),
        "joint_rotation": way * m.joint_rotation,
        "joint_min": np.where(swap, -m.joint_max, m.joint_min),
        "joint_max": np.where(swap, -m.joint_min, m.joint_max),
    }
    state = {
        "joint_impulse": way[:, None] * level.state.joint_impulse,
        "joint_angular_impulse": way * level.state.joint_angular_impulse,
    }
    return edited(level, model, state)


def renamed(level: Level, rng: np.random.Generator) -> Level:
    """Permute the entries of the action; reverse which direction of some motor entries is forward."""
    return with_names(level, *names(rng))


def names(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw permutations of motor and thruster entries, and which motor entries (old indices) are reversed."""
    return rng.permutation(MOTOR_BINDINGS), rng.permutation(THRUSTER_BINDINGS), rng.random(MOTOR_BINDINGS) < 0.5


def with_names(level: Level, motor: np.ndarray, thruster: np.ndarray, backward: np.ndarray) -> Level:
    # inactive actuators of handmade levels have bindings beyond the last
    flames = np.minimum(level.thruster_binding, THRUSTER_BINDINGS - 1)
    level = edited(level, motor_binding=np.minimum(level.motor_binding, MOTOR_BINDINGS - 1))
    against = backward[level.motor_binding] & ~level.motor_auto
    level = swapped(level, against & weakened(level))  # exchanging sides alone reverses a motor with limits
    speed = np.where(against & ~weakened(level), -1, 1).astype(np.float32) * level.model.motor_speed
    return edited(
        level,
        {"motor_speed": speed},
        motor_binding=motor[level.motor_binding].astype(np.int32),
        thruster_binding=thruster[flames].astype(np.int32),
    )


def more_room(level: Level, rng: np.random.Generator) -> Level:
    """Copy a level to a larger size, with unused rows in between."""
    old, m, number = level.size, level.model, lambda x: np.where(x >= level.size.polygons, x + 2, x).astype(np.int32)
    grow = lambda x, count, axis=0: np.insert(x, [x.shape[axis]] * count, 0, axis)

    def body(x: np.ndarray, axis: int = 0) -> np.ndarray:
        polygons, circles = np.split(x, [old.polygons], axis)
        return np.concatenate([grow(polygons, 2, axis), grow(circles, 1, axis)], axis)

    model = {name: body(getattr(m, name)) for name in BODY} | {"collides": body(body(m.collides), 1)}
    model |= {name: grow(getattr(m, name), 2) for name in (*JOINT, "vertices", "n_vertices")}
    model |= {name: grow(getattr(m, name), 1) for name in (*THRUSTER, "radius")}
    model |= {name: number(model[name]) for name in ("joint_a", "joint_b", "thruster_body")}
    state = {name: body(getattr(level.state, name)) for name in MOTION}
    state |= {name: grow(getattr(level.state, name), 2) for name in IMPULSES}
    own = {name: grow(getattr(level, name), 2) for name in BOUND}
    own |= {"role": body(level.role), "density": body(level.density)}
    return edited(level, model, state, thruster_binding=grow(level.thruster_binding, 1), **own)


def idle_changed(level: Level, rng: np.random.Generator) -> Level:
    """Change values wherever they have no effect."""
    other: Level = jax.tree.map(np.array, level)
    model, any_of = other.model, lambda x: rng.normal(0, 1, x.shape).astype(np.float32)
    free = ~model.active
    for values in (*(getattr(other.state, name) for name in MOTION), model.inverse_mass, model.friction, model.radius):
        unused = free[level.size.polygons :] if values is model.radius else free
        unused = np.broadcast_to(unused.reshape(len(unused), *[1] * (values.ndim - 2), unused.shape[-1]), values.shape)
        values[unused] = any_of(values)[unused]
    unlimited = ~model.joint_limited | model.joint_fixed | ~model.joint_active
    for values in (model.joint_min, model.joint_max):
        values[unlimited] = any_of(values)[unlimited]
    model.joint_rotation[unlimited & ~model.joint_fixed] = 0.7
    off = ~model.motor_on | model.joint_fixed | ~model.joint_active
    model.motor_speed[off] = any_of(model.motor_speed)[off]
    other.motor_binding[off] = rng.integers(0, MOTOR_BINDINGS, off.sum())
    other.thruster_binding[~model.thruster_active] = rng.integers(0, THRUSTER_BINDINGS)
    model.thruster_power[~model.thruster_active] = 0.3
    other.density[...] = 3.0
    other.role[free] = rng.integers(0, 4)
    return other
