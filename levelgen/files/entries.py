"""The entries of a level file, with their names, types and bounds, and the reading of untrusted values.

Names, their order and which are required follow `kinetix.util.saving` 3.0.2 and the types it stores
(`kinetix.environment.env_state`, `jax2d.sim_state`).
"""

import json
from dataclasses import dataclass
from typing import Any

from levelproof.levelgen.level import MAX_PER_KIND, MOTOR_BINDINGS, THRUSTER_BINDINGS, Role
from levelproof.levelgen.task.rules import MAX_REWARD_SCALE, MAX_STEPS
from levelproof.physics.types import (
    FIXED_POLYGONS,
    MAX_CONSTANT,
    MAX_DT,
    MAX_VERTICES,
    MIN_DT,
    SOLVER_BATCH,
    SOLVER_ITERATIONS,
    Size,
)

MAX_QUANTITY = 1000.0  # of a body, joint or thruster; the engine itself clips at 15 m and 100 m/s
MAX_INVERSE = 1e9  # 1/kg and 1/(kg m^2)


class LevelFileError(ValueError):
    """A level file is unusable, or a level does not fit into one; the message says where, and what is allowed."""


@dataclass(frozen=True)
class Entry:
    """One entry of a file: a number or bool, or an array of them as nested objects with the keys "0", "1", ..."""

    kind: type[float] | type[int] | type[bool]
    low: float = 0.0
    high: float = 0.0
    shape: tuple[int, ...] = ()

    def read(self, parent: object, name: str, where: str) -> Any:
        """Read the value `name` of the object at `where`; return nested lists if the entry is an array.

        Raises:
            LevelFileError: the value is missing or invalid.
        """
        return self._read(item(parent, name, where), f"{where}.{name}", self.shape)

    def _read(self, value: object, where: str, shape: tuple[int, ...]) -> Any:
        if shape:
            return [self._read(item(value, str(i), where), f"{where}.{i}", shape[1:]) for i in range(shape[0])]
        if self.kind is bool:
            valid = isinstance(value, bool)
        else:
            numbers = int if self.kind is int else int | float
            valid = isinstance(value, numbers) and not isinstance(value, bool) and self.low <= value <= self.high
        if not valid:
            number = f"a {'whole ' if self.kind is int else ''}number from {self.low:,g} to {self.high:,g}"
            wanted = "true or false" if self.kind is bool else number
            raise LevelFileError(f"{where} is {abbreviate(value)}, but must be {wanted}")
        return self.kind(value)  # pyright: ignore[reportArgumentType]


def item(parent: object, name: str, where: str) -> object:
    """Return an object's entry.

    Args:
        parent: the object.
        name: key of the entry.
        where: path of the object in the file, for error messages; "" for the whole file.

    Raises:
        LevelFileError: `parent` is not an object, or has no such entry.
    """
    if not isinstance(parent, dict):
        raise LevelFileError(f"{where or 'the whole file'} is {abbreviate(parent)}, but must be an object")
    if name not in parent:
        raise LevelFileError(f"{where}{'.' if where else ''}{name} is missing")
    return parent[name]


def abbreviate(value: object) -> str:
    """Abbreviate a value for an error message."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "a list"
    words = json.dumps(value[:40] if isinstance(value, str) else value)
    return words if len(words) <= 40 else f"{words[:40]} ..."


def _real(*shape: int) -> Entry:
    return Entry(float, -MAX_QUANTITY, MAX_QUANTITY, shape)


FLAG = Entry(bool)
AMOUNT = Entry(float, 0.0, MAX_QUANTITY)
INVERSE = Entry(float, 0.0, MAX_INVERSE)
BINDING = Entry(int, 0, 255)  # of inactive actuators; level_file checks the active ones
GRAVITY = _real(2)
IN_WORLD = Entry(float, -10 * MAX_QUANTITY, 10 * MAX_QUANTITY, (2,))  # computed from a position and an anchor
BODY = {
    "position": _real(2),
    "rotation": _real(),
    "velocity": _real(2),
    "angular_velocity": _real(),
    "inverse_mass": INVERSE,
    "inverse_inertia": INVERSE,
    "friction": AMOUNT,
    "restitution": AMOUNT,
    "collision_mode": Entry(int, 0, 2),
    "active": FLAG,
    "n_vertices": Entry(int, 0, MAX_VERTICES),
    "vertices": _real(MAX_VERTICES, 2),
    "radius": AMOUNT,
    "role": Entry(int, 0, max(Role)),
    "density": AMOUNT,
}


def entries_of(size: Size) -> dict[str, dict[str, Entry]]:
    """Return the entries of polygons, circles, joints and thrusters."""
    body = Entry(int, 0, size.bodies - 1)
    joint = {
        "a_index": body,
        "b_index": body,
        "a_relative_pos": _real(2),
        "b_relative_pos": _real(2),
        "global_position": IN_WORLD,
        "active": FLAG,
        "acc_impulse": _real(2),
        "acc_r_impulse": _real(),
        "motor_speed": _real(),
        "motor_power": _real(),
        "motor_on": FLAG,
        "motor_has_joint_limits": FLAG,
        "min_rotation": _real(),
        "max_rotation": _real(),
        "is_fixed_joint": FLAG,
        "rotation": _real(),
        "motor_binding": BINDING,
    }
    thruster = {
        "object_index": body,
        "relative_position": _real(2),
        "rotation": _real(),
        "power": _real(),
        "global_position": IN_WORLD,
        "active": FLAG,
        "thruster_binding": BINDING,
    }
    return {"polygon": BODY, "circle": BODY, "joint": joint, "thruster": thruster}


_COUNTS_FROM_0 = dict.fromkeys(("num_circles", "num_joints", "num_thrusters"), Entry(int, 0, MAX_PER_KIND))
COUNTS = {"num_polygons": Entry(int, FIXED_POLYGONS, MAX_PER_KIND), **_COUNTS_FROM_0}
STATIC_CONSTANTS = {  # this engine supports one value of each
    "max_polygon_vertices": MAX_VERTICES,
    "num_solver_iterations": SOLVER_ITERATIONS,
    "solver_batch_size": SOLVER_BATCH,
    "do_warm_starting": True,
    "num_static_fixated_polys": FIXED_POLYGONS,
    "num_motor_bindings": MOTOR_BINDINGS,
    "num_thruster_bindings": THRUSTER_BINDINGS,
}
# required by the reference; nothing here depends on them
STATIC_EXTRA = {"screen_dim": {"0": 500, "1": 500}, "downscale": 4, "max_shape_size": 2}
EXTRA = {"pixels_per_unit": 100, "num_shape_roles": len(Role)}
NO_CONTACT = {
    "normal": {"0": 0.0, "1": 0.0},
    "penetration": 0.0,
    "collision_point": {"0": 0.0, "1": 0.0},
    "active": False,
    "acc_impulse_normal": 0.0,
    "acc_impulse_tangent": 0.0,
    "restitution_velocity_target": 0.0,
}

STEPS = Entry(int, 1, MAX_STEPS)
TASK = {"max_timesteps": STEPS, "dense_reward_scale": Entry(float, 0.0, MAX_REWARD_SCALE)}
PHYSICS = {  # our name in physics.types.Params -> the reference's
    "dt": "dt",
    "slop": "slop",
    "joint_bias_velocity": "baumgarte_coefficient_joints_v",
    "joint_bias_position": "baumgarte_coefficient_joints_p",
    "fixed_joint_bias": "baumgarte_coefficient_fjoint_av",
    "joint_limit_bias": "baumgarte_coefficient_rjoint_limit_av",
    "contact_bias": "baumgarte_coefficient_collision",
    "joint_stiffness": "joint_stiffness",
    "max_position": "clip_position",
    "max_velocity": "clip_velocity",
    "max_angular_velocity": "clip_angular_velocity",
    "motor_speed": "base_motor_speed",
    "motor_power": "base_motor_power",
    "thruster_power": "base_thruster_power",
    "motor_decay": "motor_decay_coefficient",
    "motor_limit_zone": "motor_joint_limit",
    "base_friction": "base_friction",
}
RULES = dict.fromkeys(PHYSICS, Entry(float, 0.0, MAX_CONSTANT)) | {"dt": Entry(float, MIN_DT, MAX_DT)}
