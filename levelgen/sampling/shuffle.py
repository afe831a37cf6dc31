"""Random order of bodies, joints and thrusters, and which bodies may collide.

Follows `kinetix.environment.utils.permute_state` 3.0.2 and `jax2d.engine.calculate_collision_matrix` 1.0.1.
"""

from dataclasses import is_dataclass, replace
from typing import NamedTuple, TypeVar, get_type_hints

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level
from levelproof.physics.types import FIXED_POLYGONS, Model, Size

T = TypeVar("T")


class OrderDraws(NamedTuple):
    """Random numbers for a random order: one for each row of every kind."""

    order: Float[Array, "row lane"]


def shuffled_rows(size: Size) -> tuple[int, int, int, int]:
    """Return the number of shuffled rows of each kind."""
    return size.polygons - FIXED_POLYGONS, size.circles, size.joints, size.thrusters


def shuffle(level: Level, draws: OrderDraws) -> Level:
    """Shuffle movable polygons, circles, joints and thrusters, each among themselves; the scenery stays."""
    model, order = level.model, draw_order(level.size, draws.order)
    row_of = jnp.argsort(order["body"], 0)  # the inverse permutation: new row of each old one
    model = replace(
        model,
        joint_a=_take(row_of, model.joint_a),
        joint_b=_take(row_of, model.joint_b),
        thruster_body=_take(row_of, model.thruster_body),
    )
    level = _in_order(replace(level, model=model), order)
    return replace(level, model=replace(level.model, collides=collision_matrix(level.model)))


def draw_order(size: Size, numbers: Float[Array, "row lane"]) -> dict[str, Int[Array, "row lane"]]:
    """Return, for each axis by its name in annotations, the row from which each row's content comes."""
    drawn = jnp.split(numbers, np.cumsum(shuffled_rows(size))[:-1])
    polygons, circles, joints, thrusters = (jnp.argsort(part, 0).astype(jnp.int32) for part in drawn)
    scenery = jnp.broadcast_to(jnp.arange(FIXED_POLYGONS)[:, None], (FIXED_POLYGONS, numbers.shape[-1]))
    polygons = jnp.concatenate([scenery, polygons + FIXED_POLYGONS])
    bodies = jnp.concatenate([polygons, circles + size.polygons])
    return {"body": bodies, "polygon": polygons, "circle": circles, "joint": joints, "thruster": thrusters}


def _in_order(arrays: T, order: dict[str, Int[Array, "row lane"]]) -> T:
    """Reorder the rows of every array of a dataclass whose first axis is in `order`."""
    reordered = {}
    for name, hint in get_type_hints(type(arrays)).items():
        values = getattr(arrays, name)
        if is_dataclass(values):
            reordered[name] = _in_order(values, order)
        elif (axis := hint.dim_str.split()[0]) in order:
            reordered[name] = _take(values, order[axis])
    return replace(arrays, **reordered)  # pyright: ignore[reportArgumentType]


def collision_matrix(model: Model) -> Bool[Array, "body body lane"]:
    """Find which bodies may collide: those that no chain of active joints holds together.

    Transitive closure by repeated squaring: each pass doubles the length of the chains that `joined` covers.
    """
    body = jnp.arange(model.size.bodies)[:, None]
    ends = [(index[:, None] == body) & model.joint_active[:, None] for index in (model.joint_a, model.joint_b)]
    first, second = ends[0][:, :, None], ends[1][:, None]
    joined = jnp.eye(model.size.bodies, dtype=bool)[..., None] | (first & second).any(0)
    joined |= joined.swapaxes(0, 1)
    for _ in range((model.size.joints - 1).bit_length()):  # chains of 1, 2, 4 ... joints
        joined = (joined[:, :, None] & joined[None]).any(1)
    return ~joined


def _take(x: Array, index: Int[Array, "row lane"]) -> Array:
    """Return x [row, ..., lane] at each lane's own rows."""
    spread = index.reshape(len(index), *[1] * (x.ndim - 2), index.shape[-1])
    return jnp.take_along_axis(x, spread, 0)
