"""Random order of bodies, joints and thrusters, and which bodies may collide.

Follows `kinetix.environment.utils.permute_state` 3.0.2 and `jax2d.engine.calculate_collision_matrix` 1.0.1.
"""

from typing import Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.levelgen.sampling.draft import Draft, LevelRows
from levelproof.physics.lanes import Ref, Scalar, each, gather
from levelproof.physics.lanes import Rows as Readable
from levelproof.physics.types import FIXED_POLYGONS, Model, Size


class NewOrder(NamedTuple):
    """The new row of each old body, joint and thruster; and the group of joined bodies in each new row."""

    body: Int[Ref, "body lane"]
    joint: Int[Ref, "joint lane"]
    thruster: Int[Ref, "thruster lane"]
    group: Int[Ref, "body lane"]


def shuffled_rows(size: Size) -> tuple[int, int, int, int]:
    """Return the number of shuffled rows of each kind: polygons but for the scenery, circles, joints, thrusters."""
    return size.polygons - FIXED_POLYGONS, size.circles, size.joints, size.thrusters


def shuffle(draft: Draft, order: NewOrder, numbers: Readable, first: int, after: LevelRows, collides: Ref) -> None:
    """Write the draft's rows to `after`, each kind in the order of its `numbers`; the scenery stays.

    Bodies that joints hold together do not collide. `numbers` has one row for each of `shuffled_rows`, kind after kind,
    from `first` on.
    """
    size = draft.size
    each(FIXED_POLYGONS, lambda i: _stay(order.body, i))
    starts = ((order.body, FIXED_POLYGONS), (order.body, size.polygons), (order.joint, 0), (order.thruster, 0))
    for (new_row, start), count in zip(starts, shuffled_rows(size), strict=True):
        _rank(numbers, first, count, new_row, start)
        first += count
    kinds = {"body": (order.body, 0), "joint": (order.joint, 0), "thruster": (order.thruster, 0)}
    kinds |= {"polygon": (order.body, 0), "circle": (order.body, size.polygons)}
    for kind, (new_row, start) in kinds.items():
        named = [name for name, hint in get_type_hints(LevelRows).items() if hint.dim_str.split()[0] == kind]
        fields = [(getattr(draft.rows, name), getattr(after, name)) for name in named]
        _move(fields + [(draft.notes.group, order.group)] * (kind == "body"), new_row, start)
    for ends in (after.joint_a, after.joint_b, after.thruster_body):
        _follow(ends, order.body)
    _let_groups_collide(order.group, collides)


def _stay(new_row: Ref, i: Scalar) -> None:
    new_row[i] = jnp.zeros_like(new_row[i]) + i


def _rank(numbers: Readable, first: int, count: int, new_row: Ref, start: int) -> None:
    """Write `start` plus the rank of each of `count` numbers, from `first` on; of two equals, the earlier is lower."""

    def one(i):
        mine = numbers[first + i]

        def before(j, rank):
            other = numbers[first + j]
            return rank + ((other < mine) | ((other == mine) & (j < i)))

        new_row[start + i] = jax.lax.fori_loop(0, count, before, jnp.full_like(new_row[start + i], start))

    each(count, one)


def _move(fields: list[tuple[Ref, Ref]], new_row: Ref, start: int) -> None:
    """Copy row i of `before` to row new_row[start + i] - start of `after`, for each (before, after) in `fields`."""
    count = fields[0][0].shape[0]

    def fill(k):
        def copy_if_here(i):
            here = new_row[start + i] == start + k
            for before, after in fields:
                after[k] = jnp.where(here, before[i], after[k])

        each(count, copy_if_here)

    each(count, fill)


def _follow(ends: Ref, new_row: Ref) -> None:
    """Replace indices of bodies by their new ones."""

    def one(i):
        ends[i] = gather(new_row.shape[0], lambda body: new_row[body], ends[i])

    each(ends.shape[0], one)


def _let_groups_collide(group: Readable, collides: Ref) -> None:
    """Write which bodies may collide: those of different groups."""

    def pair(i, j):
        collides[i, j] = group[i] != group[j]

    count = collides.shape[0]
    each(count, lambda i: each(count, lambda j: pair(i, j)))


def collision_matrix(model: Model) -> Bool[Array, "body body lane"]:
    """Find which bodies may collide: those that no chain of active joints holds together.

    Transitive closure by repeated squaring: each pass doubles the length of the chains that `joined` covers. Numpy
    inputs are computed in numpy, which takes a tenth of the time for one level.
    """
    body = np.arange(model.size.bodies)[:, None]
    ends = [(index[:, None] == body) & model.joint_active[:, None] for index in (model.joint_a, model.joint_b)]
    first, second = ends[0][:, :, None], ends[1][:, None]
    joined: Any = np.eye(model.size.bodies, dtype=bool)[..., None] | (first & second).any(0)
    joined |= joined.swapaxes(0, 1)
    for _ in range((model.size.joints - 1).bit_length()):  # chains of 1, 2, 4 ... joints
        joined = (joined[:, :, None] & joined[None]).any(1)
    return ~joined
