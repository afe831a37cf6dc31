"""Levels as table columns and back, bit for bit: one column per array of `Level`, one row per level.

A column has the name of the dataclass's field, such as `position` or `joint_anchor_a`; names are unique, also among the
manifest's columns. Entries are nested lists in the shape of the array. Does no I/O.
"""

import numpy as np
import pyarrow as pa

from levelproof.levelgen.level import Level, size_of
from levelproof.physics.types import Size
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.contents import check_numbers, level_fields
from levelproof.pipeline.store.fields import arrays_of, tree_of
from levelproof.pipeline.store.formats import ContentsError, FieldSpec


def column_fields(size: Size) -> dict[str, FieldSpec]:
    """Return the non-empty fields of levels of this size, by column name."""
    return {field.name.rpartition("/")[2]: field for field in level_fields(size) if field.count}


def columns_for(level: Level) -> dict[str, pa.Array]:
    """Convert levels, level axis last, to columns with one row per level."""
    arrays = arrays_of(level, "level/")
    return {name: _nested(np.moveaxis(arrays[field.name], -1, 0)) for name, field in column_fields(level.size).items()}


def levels_from(table: pa.Table) -> Level:
    """Convert rows of a table from `levelproof export --format parquet` to levels.

    Args:
        table: any rows of one size, at least one, in any order; needs the column `size` and those of levels, and
            ignores others.

    Returns:
        Numpy arrays (float32, int32 or bool), level axis last, in row order: bit for bit the exported levels.

    Raises:
        UserError: the rows have several sizes, or a column is missing or holds values that no level can have.
    """
    try:
        sizes = table.column("size").unique().to_pylist()
        if len(sizes) != 1:
            raise UserError(f"The table has levels of sizes {sizes}: select rows of one size.")
        size = size_of(sizes[0])
        columns = {field.name: name for name, field in column_fields(size).items()}
        arrays = {field.name: _array(table, columns.get(field.name), field) for field in level_fields(size)}
        check_numbers(arrays, size)
    except (KeyError, ContentsError, ValueError, TypeError) as error:  # pyarrow's errors derive from these
        reason = str(error).strip("'\"").splitlines()[0]
        raise UserError(f"The table lacks valid level columns ({reason}): pass rows as `export` wrote them.") from None
    return tree_of(Level, arrays, "level/")


def _nested(values: np.ndarray) -> pa.Array:
    """Convert (level, ...) to one nested list per level.

    Avoids fixed-size lists: pyarrow 26 crashes with a segmentation fault when it filters chunked rows of those.
    """
    column = pa.array(np.ascontiguousarray(values).reshape(-1))
    for length in reversed(values.shape[1:]):
        column = pa.ListArray.from_arrays(np.arange(0, len(column) + 1, length, dtype=np.int32), column)
    return column


def _array(table: pa.Table, name: str | None, field: FieldSpec) -> np.ndarray:
    """Invert `_nested`, level axis last; zeros if the size has no such column (`name` None)."""
    dtype, shape = np.dtype(field.dtype), (table.num_rows, *field.shape)
    if name is None:
        return np.moveaxis(np.zeros(shape, dtype), 0, -1)
    column = table.column(name)
    while pa.types.is_nested(column.type):
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks], column.type.value_type)
    if column.null_count or column.type != pa.from_numpy_dtype(dtype):
        raise ContentsError(f"{name} is not entirely {dtype}")
    return np.ascontiguousarray(np.moveaxis(column.to_numpy().reshape(shape), 0, -1))
