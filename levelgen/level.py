"""A level: an immutable initial world with roles and bindings, and its sizes.

Batches of levels have the level axis LAST, like everything else (a batch of levels is a batch of lanes).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.types import Model, Size, State

SIZES: dict[str, Size] = {
    "s": Size(polygons=5, circles=2, joints=1, thrusters=1),
    "m": Size(polygons=6, circles=3, joints=2, thrusters=2),
    "l": Size(polygons=12, circles=4, joints=6, thrusters=2),
}
MAX_THINGS = 64  # of a kind in a level; a level file with so many of each has 3 MB
MOTOR_BINDINGS = 4  # entries of an action that motors obey
THRUSTER_BINDINGS = 2  # entries that thrusters obey
ACTIONS = MOTOR_BINDINGS + THRUSTER_BINDINGS
WORLD_SIDE = 5.0  # m
HALF_WORLD = WORLD_SIDE / 2


class Role(IntEnum):
    """What a body is in the goal. The numbers are those of the reference's files."""

    PLAIN = 0
    GREEN = 1
    BLUE = 2
    RED = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Level:
    """An immutable initial world, or many: the level axis is the last of every array (`lane`).

    `model` (what is constant) and `state` (what evolves) are the engine's, the rest is what the task adds.
    `len(levels)` counts levels; `levels[0]`, `levels[10:20]` and `levels[mask]` choose some. What they give has a level
    axis too, so that every function of levels takes it. `concatenate_levels` joins.
    """

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

    def __len__(self) -> int:
        lanes = {x.shape[-1] for x in jax.tree.leaves(self)}
        return 0 if 0 in lanes else max(lanes)

    def __getitem__(self, index: Any) -> "Level":
        """Levels by index (negative ones count from the end), slice, list of indices or mask, as numpy arrays.

        Raises:
            IndexError: there is no such level.
        """
        chosen = np.atleast_1d(np.arange(len(self))[index])
        of_each = lambda x: np.broadcast_to(x, (*x.shape[:-1], len(self)))  # in numpy: JAX would compile each shape
        return jax.tree.map(lambda x: of_each(np.asarray(x))[..., chosen], self)


def concatenate_levels(parts: Sequence[Level]) -> Level:
    """Join levels of one size, such as those of several calls, in their order, as numpy arrays.

    Raises:
        ValueError: there are none, or sizes differ.
    """
    sizes = list(dict.fromkeys(part.size for part in parts))
    if len(sizes) != 1:
        names = ", ".join(map(name_of, sizes))
        raise ValueError(f"levels of the sizes {names} cannot be joined" if sizes else "there are no levels to join")
    return jax.tree.map(lambda *lanes: np.concatenate(lanes, -1), *(part[:] for part in parts))


def size_of(name: str | Size) -> Size:
    """The size with this name: one of SIZES, or four numbers as in `8-8-8-4`. A Size is returned as it is.

    The numbers count polygons (the scenery's four included), circles, joints and thrusters.

    Raises:
        ValueError: it is no name of a size, or not its only one; the message starts with `size`.
    """
    if isinstance(name, Size):
        return name
    if name in SIZES:
        return SIZES[name]
    if not re.fullmatch(r"(0|[1-9][0-9]{0,3})(-(0|[1-9][0-9]{0,3})){3}", name):
        raise ValueError(
            f"size is {name!r}: choose one of {', '.join(SIZES)}, or write how many polygons (4 of them scenery), "
            "circles, joints and thrusters there is room for, as in 8-8-8-4"
        )
    size = Size(*map(int, name.split("-")))
    if name_of(size) != name:
        raise ValueError(f"size is {name}: that is {name_of(size)}, so write that")
    for kind, count in zip(size._fields, size, strict=True):
        if count > MAX_THINGS:
            raise ValueError(f"size is {name}: at most {MAX_THINGS} {kind} fit into a level")
    return size


def name_of(size: Size) -> str:
    """The name that `size_of` reads."""
    return next((name for name, known in SIZES.items() if known == size), "-".join(map(str, size)))
