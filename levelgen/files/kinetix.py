"""The reference's states as plain arrays, to and from ours.

Here a state of Kinetix 3.0.2 is a dict of numpy arrays: names are the paths of its `EnvState`
(`polygon/position`, `acc_rr_manifolds/active`, `gravity` ...), and the level axis is FIRST, as `vmap` leaves it.
Ours has it last. Numpy in, numpy out; nothing here imports the reference.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from levelgen.level import Level
from physics.pairs import pairs_of
from physics.types import MAX_VERTICES, Manifold, Model, Size, State

Fields = dict[str, np.ndarray]

MANIFOLDS = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")
# our name of a body's attribute -> theirs; polygons and circles share them
BODY_CONSTANTS = {
    "active": "active",
    "inverse_mass": "inverse_mass",
    "inverse_inertia": "inverse_inertia",
    "friction": "friction",
    "restitution": "restitution",
    "collision_mode": "collision_mode",
}
BODY_DYNAMICS = ("position", "rotation", "velocity", "angular_velocity")
CONTACTS = {
    "contact_active": "active",
    "contact_normal_impulse": "acc_impulse_normal",
    "contact_tangent_impulse": "acc_impulse_tangent",
}
MANIFOLD_FIELDS = {
    "normal": "normal",
    "penetration": "penetration",
    "point": "collision_point",
    "restitution_velocity": "restitution_velocity_target",
}
MODEL_FIELDS = {
    "gravity": "gravity",
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
JOINT_IMPULSES = {"joint_impulse": "joint/acc_impulse", "joint_angular_impulse": "joint/acc_r_impulse"}
BINDINGS = {"motor_binding": "motor_bindings", "motor_auto": "motor_auto", "thruster_binding": "thruster_bindings"}


def level_from_kinetix(fields: Mapping[str, np.ndarray]) -> Level:
    """Levels whose initial state is the reference's state (impulses included), level axis last."""
    constants = {ours: _bodies(fields, theirs) for ours, theirs in BODY_CONSTANTS.items()}
    constants |= {ours: _last(fields[theirs]) for ours, theirs in MODEL_FIELDS.items()}
    return Level(
        model=Model(**constants),
        state=state_from_kinetix(fields),
        role=_last(np.concatenate([fields["polygon_shape_roles"], fields["circle_shape_roles"]], 1)),
        density=_last(np.concatenate([fields["polygon_densities"], fields["circle_densities"]], 1)),
        **{ours: _last(fields[theirs]) for ours, theirs in BINDINGS.items()},
    )


def state_from_kinetix(fields: Mapping[str, np.ndarray]) -> State:
    """Only what evolves, level axis last."""
    values = {name: _bodies(fields, name) for name in BODY_DYNAMICS}
    values |= {ours: _contacts(fields, theirs) for ours, theirs in CONTACTS.items()}
    values |= {ours: _last(fields[theirs]) for ours, theirs in JOINT_IMPULSES.items()}
    return State(**values)


def state_to_kinetix(
    level: Level,
    state: State,
    timestep: Int[np.ndarray, "level"],
    last_distance: Float[np.ndarray, "level"],
    manifold: Manifold | None = None,
    joint_point: Float[np.ndarray, "joint 2 level"] | None = None,
    thruster_point: Float[np.ndarray, "thruster 2 level"] | None = None,
) -> Fields:
    """Every field of the reference's state, level axis first.

    What its next step does not depend on (manifold geometry, cached points) is zero where not given.
    """
    size, lanes = level.size, len(timestep)
    fields = {theirs: _first(getattr(level.model, ours)) for ours, theirs in MODEL_FIELDS.items()}
    fields |= {theirs: _first(getattr(level, ours)) for ours, theirs in BINDINGS.items()}
    fields |= {theirs: _first(getattr(state, ours)) for ours, theirs in JOINT_IMPULSES.items()}
    for ours, theirs in BODY_CONSTANTS.items():
        fields |= _split_bodies(size, getattr(level.model, ours), theirs)
    for name in BODY_DYNAMICS:
        fields |= _split_bodies(size, getattr(state, name), name)
    for ours, theirs in CONTACTS.items():
        fields |= _split_contacts(size, getattr(state, ours), theirs)
    for ours, theirs in MANIFOLD_FIELDS.items():
        fields |= _split_contacts(size, getattr(manifold or _no_manifold(size, lanes), ours), theirs)
    fields |= _roles_and_densities(level)
    return fields | {
        "joint/global_position": _point(joint_point, size.joints, lanes),
        "thruster/global_position": _point(thruster_point, size.thrusters, lanes),
        "polygon/radius": np.zeros((lanes, size.polygons), np.float32),
        "circle/vertices": np.zeros((lanes, size.circles, MAX_VERTICES, 2), np.float32),
        "circle/n_vertices": np.zeros((lanes, size.circles), np.int32),
        "timestep": np.asarray(timestep, np.int32),
        "last_distance": np.asarray(last_distance, np.float32),
    }


def _last(values: np.ndarray) -> Any:
    """Level axis from first to last, in the engine's 32-bit types, contiguous (numpy, where types say jax)."""
    values = np.moveaxis(np.asarray(values), 0, -1)
    kind = values.dtype.kind
    return np.ascontiguousarray(values, bool if kind == "b" else np.int32 if kind in "iu" else np.float32)


def _first(values: ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(np.asarray(values), -1, 0))


def _bodies(fields: Mapping[str, np.ndarray], name: str) -> Any:
    return _last(np.concatenate([fields[f"polygon/{name}"], fields[f"circle/{name}"]], 1))


def _contacts(fields: Mapping[str, np.ndarray], name: str) -> Any:
    """In the numbering of physics/pairs.py; the reference keeps a polygon pair's two points side by side."""
    polygon, circle_polygon, circle = (fields[f"{manifold}/{name}"] for manifold in MANIFOLDS)
    return _last(np.concatenate([polygon[:, :, 0], polygon[:, :, 1], circle_polygon, circle], 1))


def _split_bodies(size: Size, values: ArrayLike, name: str) -> Fields:
    first = _first(values)
    return {f"polygon/{name}": first[:, : size.polygons], f"circle/{name}": first[:, size.polygons :]}


def _split_contacts(size: Size, values: ArrayLike, name: str) -> Fields:
    pairs = pairs_of(size)
    polygon, circle_polygon = len(pairs.polygon), len(pairs.circle_polygon)
    ends = np.cumsum([polygon, polygon, circle_polygon])
    first, second, *others = np.split(_first(values), ends, axis=1)
    return {
        f"{kind}/{name}": part for kind, part in zip(MANIFOLDS, [np.stack([first, second], 2), *others], strict=True)
    }


def _no_manifold(size: Size, lanes: int) -> Manifold:
    contacts = pairs_of(size).contacts
    scalar: Any = np.zeros((contacts, lanes), np.float32)
    vector: Any = np.zeros((contacts, 2, lanes), np.float32)
    return Manifold(scalar.astype(bool), vector, scalar, vector, scalar)


def _roles_and_densities(level: Level) -> Fields:
    """The reference keeps them outside its bodies, with an editor's `highlighted` flag that levels never set."""
    fields, polygons = {}, level.size.polygons
    for ours, theirs in (("role", "shape_roles"), ("density", "densities")):
        values = _first(getattr(level, ours))
        fields |= {f"polygon_{theirs}": values[:, :polygons], f"circle_{theirs}": values[:, polygons:]}
    fields["polygon_highlighted"] = np.zeros(fields["polygon_shape_roles"].shape, bool)
    fields["circle_highlighted"] = np.zeros(fields["circle_shape_roles"].shape, bool)
    return fields


def _point(values: np.ndarray | None, count: int, lanes: int) -> np.ndarray:
    return np.zeros((lanes, count, 2), np.float32) if values is None else _first(values)
