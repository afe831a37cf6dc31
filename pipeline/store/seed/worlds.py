"""Levels without an id, packed: the fields of a level as a shard of density `witness` has them."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from levelproof.levelgen.level import Level, name_of
from levelproof.physics.types import Size
from levelproof.pipeline.store.contents import blank_row, check_numbers, none_of
from levelproof.pipeline.store.fields import arrays_of, tree_of
from levelproof.pipeline.store.formats import FLAT, FieldSpec, field_table
from levelproof.pipeline.store.packing import pack, unpack


def pack_worlds(level: Level) -> list[bytes]:
    """Pack each level: its fields as bytes, exclusive or with those of the empty level."""
    table = _table(level.size)
    packed = pack(arrays_of(level, "level/"), table)[FLAT] ^ blank_row(level.size, table)
    return [row.tobytes() for row in packed]


def unpack_worlds(packed: Sequence[bytes], size: Size) -> Level:
    """Unpack levels of a size, level axis last.

    Raises:
        ValueError: these are not levels of this size.
    """
    table = _table(size)
    blank = blank_row(size, table)
    if any(len(one) != len(blank) for one in packed):
        raise ValueError(f"it does not contain levels of size {name_of(size)}")
    rows = np.frombuffer(b"".join(packed), np.uint8).reshape(len(packed), len(blank)) ^ blank
    arrays = unpack({FLAT: rows}, table)
    check_numbers(arrays, size)
    return tree_of(Level, {name: np.ascontiguousarray(np.moveaxis(x, 0, -1)) for name, x in arrays.items()}, "level/")


@cache
def _table(size: Size) -> tuple[FieldSpec, ...]:
    """Return the layout of a level alone; in a shard, a record's fields lie in between."""
    return tuple(field_table(arrays_of(none_of(size)[0], "level/"), "witness"))
