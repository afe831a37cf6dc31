"""A level: an immutable initial world with roles and bindings, and its sizes.

Batches of levels have the level axis LAST, like everything else (a batch of levels is a batch of lanes).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.types import Model, Size, State

SIZES: dict[str, Size] = {
    "s": Size(polygons=5, circles=2, joints=1, thrusters=1),
    "m": Size(polygons=6, circles=3, joints=2, thrusters=2),
    "l": Size(polygons=12, circles=4, joints=6, thrusters=2),
}
MAX_PER_KIND = 64  # polygons, circles, joints or thrusters in a level; a level file with 64 of each is 3 MB long
MOTOR_BINDINGS = 4  # entries of an action that motors obey
THRUSTER_BINDINGS = 2  # entries that thrusters obey
ACTIONS = MOTOR_BINDINGS + THRUSTER_BINDINGS
WORLD_SIDE = 5.0  # m
HALF_WORLD = WORLD_SIDE / 2
KERNEL_SOURCES = [Path(__file__).parents[1] / room for room in ("physics", "levelgen")]  # of kernels over levels


class Role(IntEnum):
    """A body's part in the goal. The values are those of the reference's files."""

    PLAIN = 0
    GREEN = 1
    BLUE = 2
    RED = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Level:
    """One immutable initial world, or many: the level axis is the last of every array (`lane`).

    `model` (constant) and `state` (evolving) belong to the engine; the task adds the rest. `len(levels)` counts
    levels; `levels[0]`, `levels[10:20]` and `levels[mask]` choose some and keep the level axis, so every function of
    levels accepts the result. `concatenate_levels` joins levels.
    """

    model: Model
    state: State
    role: Int[Array, "body lane"]  # Role
    density: Float[Array, "body lane"]  # kg/m^2
    motor_binding: Int[Array, "joint lane"]  # 0 .. MOTOR_BINDINGS - 1
    motor_auto: Bool[Array, "joint lane"]  # runs forward whatever the action is
    thruster_binding: Int[Array, "thruster lane"]  # 0 .. THRUSTER_BINDINGS - 1

    @property
    def size(self) -> Size:
        return self.model.size

    def __len__(self) -> int:
        lanes = {x.shape[-1] for x in jax.tree.leaves(self)}
        return 0 if 0 in lanes else max(lanes)

    def __getitem__(self, index: Any) -> "Level":
        """Choose levels by index (negative: from the end), slice, list of indices or mask, as numpy arrays.

        Raises:
            IndexError: there is no such level.
        """
        chosen = np.atleast_1d(np.arange(len(self))[index])
        return jax.tree.map(lambda x: x[..., chosen], expanded(self))


def concatenate_levels(parts: Sequence[Level]) -> Level:
    """Join levels of one size, such as the results of several calls, in order, as numpy arrays.

    Raises:
        ValueError: there are no levels, or their sizes differ.
    """
    sizes = list(dict.fromkeys(part.size for part in parts))
    if len(sizes) != 1:
        names = ", ".join(map(name_of, sizes))
        raise ValueError(f"levels of the sizes {names} cannot be joined" if sizes else "there are no levels to join")
    return jax.tree.map(lambda *lanes: np.concatenate(lanes, -1), *map(expanded, parts))


def expanded(level: Level) -> Level:
    """Return numpy views of all arrays with as many lanes as the level has."""
    lanes = len(level)
    expand = lambda x: np.broadcast_to(x, (*x.shape[:-1], lanes))  # in numpy: JAX would compile each shape
    return jax.tree.map(lambda x: expand(np.asarray(x)), level)


def on_device(levels: Level) -> Level:
    """Return levels as JAX arrays, each with as many lanes as there are levels.

    Raises:
        ValueError: there are no levels, or the level axis is missing or not the last one.
    """
    lanes = sorted({count for x in jax.tree.leaves(levels) for count in x.shape[-1:]})
    count = lanes[-1]
    if np.ndim(levels.role) != 2 or 0 in lanes or not {*lanes} <= {1, count}:
        raise ValueError(
            f"levels.role has shape {np.shape(levels.role)}, which must be (bodies, levels), and last axes have "
            f"lengths {', '.join(map(str, lanes))}, which must be the number of levels, or 1: give at least one level, "
            "level axis last, as sample_levels and Sampler.lanes do"
        )
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x), (*x.shape[:-1], count)), levels)


def size_of(name: str | Size) -> Size:
    """Return the size of a name: one of SIZES, or four numbers as in `8-8-8-4`. A Size stays unchanged.

    The numbers count polygons (the scenery's four included), circles, joints and thrusters.

    Raises:
        ValueError: the name is invalid or not the canonical one; the message starts with `size`.
    """
    if isinstance(name, Size):
        return name
    if name in SIZES:
        return SIZES[name]
    if not re.fullmatch(r"(0|[1-9][0-9]{0,3})(-(0|[1-9][0-9]{0,3})){3}", name):
        raise ValueError(
            f"size is {name!r}: choose one of {', '.join(SIZES)}, or give the numbers of polygons (4 are scenery), "
            "circles, joints and thrusters, as in 8-8-8-4"
        )
    size = Size(*map(int, name.split("-")))
    if name_of(size) != name:
        raise ValueError(f"size is {name}: write {name_of(size)} instead")
    for kind, count in zip(size._fields, size, strict=True):
        if count > MAX_PER_KIND:
            raise ValueError(f"size is {name}: at most {MAX_PER_KIND} {kind} fit into a level")
    return size


def name_of(size: Size) -> str:
    """Return the canonical name of a size, which `size_of` reads."""
    return next((name for name, known in SIZES.items() if known == size), "-".join(map(str, size)))
