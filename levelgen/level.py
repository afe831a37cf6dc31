"""A level: an immutable initial world with roles and bindings, and its sizes.

Batches of levels have the level axis LAST, like everything else (a batch of levels is a batch of lanes).
"""

from dataclasses import dataclass
from enum import IntEnum

import jax
from jaxtyping import Array, Bool, Float, Int

from physics.types import Model, Size, State

SIZES: dict[str, Size] = {
    "s": Size(polygons=5, circles=2, joints=1, thrusters=1),
    "m": Size(polygons=6, circles=3, joints=2, thrusters=2),
    "l": Size(polygons=12, circles=4, joints=6, thrusters=2),
}
MOTOR_BINDINGS = 4  # entries of an action that motors obey
THRUSTER_BINDINGS = 2  # entries that thrusters obey
ACTIONS = MOTOR_BINDINGS + THRUSTER_BINDINGS
WORLD_SIDE = 5.0  # m


class Role(IntEnum):
    """What a body is in the goal. The numbers are those of the reference's files."""

    PLAIN = 0
    GREEN = 1
    BLUE = 2
    RED = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Level:
    """An initial world. `model` and `state` are the engine's, the rest is what the task adds."""

    model: Model
    state: State
    role: Int[Array, "body lane"]  # Role
    density: Float[Array, "body lane"]  # kg/m^2
    motor_binding: Int[Array, "joint lane"]  # 0 .. MOTOR_BINDINGS - 1
    motor_auto: Bool[Array, "joint lane"]  # runs forward whatever the action
    thruster_binding: Int[Array, "thruster lane"]  # 0 .. THRUSTER_BINDINGS - 1

    @property
    def size(self) -> Size:
        return self.model.size
