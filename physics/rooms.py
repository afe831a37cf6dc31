"""Shapes of the arrays that a step reads, writes and works in."""

from typing import Any, NamedTuple

import jax

from physics.body import Bodies
from physics.contact import Constraints
from physics.engine import Scratch
from physics.joint import Joints
from physics.manifold import Polygons
from physics.pairs import GROUPS, KINDS, pairs_of, table_of
from physics.types import MAX_VERTICES, Manifold, Size


class Room(NamedTuple):
    """An array: its shape without lanes, its dtype, and whether it has lanes."""

    shape: tuple[int, ...]
    dtype: str = "float32"
    lanes: bool = True


def is_room(x: object) -> bool:
    return isinstance(x, Room)


def room(*shape: int, dtype: str = "float32", lanes: bool = True) -> Any:
    """A Room that stands where an array or a reference will be."""
    return Room(shape, dtype, lanes)


def rooms_of(arrays: Any) -> Any:
    """The rooms of a tree of arrays that have lanes."""
    return jax.tree.map(lambda x: Room(x.shape[:-1], str(x.dtype)), arrays)


def scratch_rooms(size: Size) -> Scratch:
    """What a step works in."""
    table, contacts = table_of(size, True), pairs_of(size).contacts
    polygons, corners, joints = size.polygons, MAX_VERTICES, size.joints
    listed = int((table.pairs * table.batches).sum()) + 1  # one more: see `contact.share_out`
    return Scratch(
        Bodies(motion=room(size.bodies, 5), push=room(size.bodies, 3), turn=room(size.bodies, 2)),
        Polygons(
            start=room(2, polygons, corners),
            edge=room(2, polygons, corners),
            along=room(2, polygons, corners),
            length=room(polygons, corners),
            support=room(polygons, corners),
            vertex=room(2, polygons, corners),
            normal=room(2, polygons, corners),
            box=room(polygons, 4),
        ),
        Joints(
            acts=room(joints, dtype="bool"),
            turns=room(joints, dtype="bool"),
            arms=room(joints, 4),
            masses=room(joints, 4),
            weight=room(joints),
            angle=room(joints),
            angle_bias=room(joints),
            impulse=room(joints, 3),
        ),
        Constraints(
            geometry=room(contacts, 4),
            effort=room(contacts, 5),
            impulse=room(contacts, 2),
            batch=room(contacts),
            touching=room(KINDS),
            acting=room(contacts, dtype="int32", lanes=False),
            counts=room(GROUPS, dtype="int32", lanes=False),
            listed=room(listed, dtype="int32", lanes=False),
            ends=room(table.segments + 1, dtype="int32", lanes=False),
        ),
    )


def manifold_rooms(size: Size) -> Manifold:
    n = pairs_of(size).contacts
    return Manifold(room(n, dtype="bool"), room(n, 2), room(n), room(n, 2), room(n))
