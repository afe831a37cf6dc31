"""Conversion between the reference's states, as plain arrays, and ours.

Here a state of Kinetix 3.0.2 is a dict of numpy arrays: names are the paths of its `EnvState`
(`polygon/position`, `acc_rr_manifolds/active`, `gravity` ...), and the level axis is FIRST, as `vmap` returns it.
Our arrays have it last. Numpy in, numpy out; nothing here imports the reference.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from levelproof.levelgen.level import Level
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, Size, State

Fields = dict[str, np.ndarray]

# Values that the reference's sampler leaves in unused fields (`fillers`), m
POLYGON_RADIUS = np.float32(0.1)
CIRCLE_VERTICES = np.float32(0.05) * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], np.float32)

BODIES = ("polygon", "circle")
MANIFOLDS = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")
# Our name -> the reference's; `*` stands for each of BODIES, `@` for each of MANIFOLDS
MODEL = {
    "gravity": "gravity",
    "active": "*/active",
    "inverse_mass": "*/inverse_mass",
    "inverse_inertia": "*/inverse_inertia",
    "friction": "*/friction",
    "restitution": "*/restitution",
    "collision_mode": "*/collision_mode",
    "collides": "collision_matrix",
    "vertices": "polygon/vertices",
    "n_vertices": "polygon/n_vertices",
    "radius": "circle/radius",
    "joint_active": "joint/active",
    "joint_a": "joint/a_index",
    "joint_b": "joint/b_index",
    "joint_anchor_a": "joint/a_relative_pos",
    "joint_anchor_b": "joint/b_relative_pos",
    "joint_fixed": "joint/is_fixed_joint",
    "joint_rotation": "joint/rotation",
    "joint_limited": "joint/motor_has_joint_limits",
    "joint_min": "joint/min_rotation",
    "joint_max": "joint/max_rotation",
    "motor_on": "joint/motor_on",
    "motor_speed": "joint/motor_speed",
    "motor_power": "joint/motor_power",
    "thruster_active": "thruster/active",
    "thruster_body": "thruster/object_index",
    "thruster_position": "thruster/relative_position",
    "thruster_rotation": "thruster/rotation",
    "thruster_power": "thruster/power",
}
STATE = {
    "position": "*/position",
    "rotation": "*/rotation",
    "velocity": "*/velocity",
    "angular_velocity": "*/angular_velocity",
    "contact_active": "@/active",
    "contact_normal_impulse": "@/acc_impulse_normal",
    "contact_tangent_impulse": "@/acc_impulse_tangent",
    "joint_impulse": "joint/acc_impulse",
    "joint_angular_impulse": "joint/acc_r_impulse",
}
MANIFOLD = {  # without `active`, which STATE has
    "normal": "@/normal",
    "penetration": "@/penetration",
    "point": "@/collision_point",
    "restitution_velocity": "@/restitution_velocity_target",
}
TASK = {
    "role": "*_shape_roles",
    "density": "*_densities",
    "motor_binding": "motor_bindings",
    "motor_auto": "motor_auto",
    "thruster_binding": "thruster_bindings",
}


def level_from_kinetix(fields: Mapping[str, np.ndarray]) -> Level:
    """Convert states to levels that start from them (impulses included), level axis last."""
    return Level(model=Model(**_ours(fields, MODEL)), state=state_from_kinetix(fields), **_ours(fields, TASK))


def state_from_kinetix(fields: Mapping[str, np.ndarray]) -> State:
    """Convert the evolving part of states, level axis last."""
    return State(**_ours(fields, STATE))


def state_to_kinetix(
    level: Level, state: State, timestep: Int[np.ndarray, "level"], last_distance: Float[np.ndarray, "level"]
) -> Fields:
    """Convert to every field of the reference's state, level axis first.

    Fields that its next step does not depend on (manifold geometry, cached points, an editor's flags) are zero.
    """
    size = level.size
    fields = level_to_kinetix(level) | to_kinetix(size, state, STATE)
    zero = lambda *shape: np.zeros((len(timestep), *shape), np.float32)
    for kind in MANIFOLDS:
        contacts = fields[f"{kind}/active"].shape[1:]
        fields |= {f"{kind}/{name}": zero(*contacts) for name in ("penetration", "restitution_velocity_target")}
        fields |= {f"{kind}/{name}": zero(*contacts, 2) for name in ("normal", "collision_point")}
    return fields | {
        "polygon_highlighted": zero(size.polygons).astype(bool),
        "circle_highlighted": zero(size.circles).astype(bool),
        "joint/global_position": zero(size.joints, 2),
        "thruster/global_position": zero(size.thrusters, 2),
        "polygon/radius": zero(size.polygons),
        "circle/vertices": zero(size.circles, MAX_VERTICES, 2),
        "circle/n_vertices": zero(size.circles).astype(np.int32),
        "timestep": np.asarray(timestep, np.int32),
        "last_distance": np.asarray(last_distance, np.float32),
    }


def level_to_kinetix(level: Level) -> Fields:
    """Convert the constant part of levels, without the fields that are always zero here; level axis first."""
    return to_kinetix(level.size, level.model, MODEL) | to_kinetix(level.size, level, TASK)


def to_kinetix(size: Size, arrays: Any, names: Mapping[str, str]) -> Fields:
    """Convert the fields in `names` of one of our dataclasses to the reference's names, level axis first."""
    fields = {}
    for ours, theirs in names.items():
        fields |= _theirs(size, theirs, np.moveaxis(np.asarray(getattr(arrays, ours)), -1, 0))
    return fields


def fillers(level: Level) -> Fields:
    """Return the values that the reference's sampler leaves in fields that nothing reads, level axis first.

    For each circle, that sampler also draws the vertices of a rectangle, which are CIRCLE_VERTICES in 70% of cases;
    this function always returns CIRCLE_VERTICES.
    """
    scenery = np.arange(level.size.polygons)[:, None] < FIXED_POLYGONS
    polygons, circles = np.split(np.asarray(level.model.active), [level.size.polygons])
    return {
        "polygon/radius": np.where(polygons & ~scenery, POLYGON_RADIUS, np.float32(0)).T,
        "circle/n_vertices": np.where(circles, MAX_VERTICES, 0).astype(np.int32).T,
        "circle/vertices": np.where(circles.T[..., None, None], CIRCLE_VERTICES, np.float32(0)),
    }


def _ours(fields: Mapping[str, np.ndarray], names: Mapping[str, str]) -> dict[str, Any]:
    """Convert to our fields: level axis last, the engine's 32-bit types, contiguous numpy (annotations say jax)."""
    converted = {}
    for ours, theirs in names.items():
        values = np.moveaxis(np.concatenate(_parts(fields, theirs), 1), 0, -1)
        kind = values.dtype.kind
        converted[ours] = np.ascontiguousarray(
            values, bool if kind == "b" else np.int32 if kind in "iu" else np.float32
        )
    return converted


def _parts(fields: Mapping[str, np.ndarray], name: str) -> list[np.ndarray]:
    """Return a field's parts in our order: first contact points of all pairs, then second ones (physics/pairs.py).

    The reference has both points of a pair side by side.
    """
    if "@" in name:
        polygons, *others = (fields[name.replace("@", kind)] for kind in MANIFOLDS)
        return [polygons[:, :, 0], polygons[:, :, 1], *others]
    return [fields[name.replace("*", kind)] for kind in (BODIES if "*" in name else BODIES[:1])]


def _theirs(size: Size, name: str, values: np.ndarray) -> Fields:
    """Convert one of our arrays, level axis first, to the reference's fields."""
    if "*" in name:
        parts = dict(zip(BODIES, np.split(values, [size.polygons], 1), strict=True))
    elif "@" in name:
        pairs = pairs_of(size)
        polygons = len(pairs.polygon)
        ends = np.cumsum([polygons, polygons, len(pairs.circle_polygon)])
        first, second, *others = np.split(values, ends, 1)
        parts = dict(zip(MANIFOLDS, [np.stack([first, second], 2), *others], strict=True))
    else:
        parts = {"": values}
    return {name.replace("*", kind).replace("@", kind): np.ascontiguousarray(part) for kind, part in parts.items()}
