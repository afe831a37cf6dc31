"""Levels as columns of a table, and back, bit for bit: one column for each array of `Level`, one row a level.

A column has the name of the dataclass's field, such as `position` or `joint_anchor_a`; no two fields share one, and
none has the name of a column of the manifest. Its entries are nested lists in the shape of the array. Knows nothing of
files.
"""

import numpy as np
import pyarrow as pa

from levelproof.levelgen.level import Level, size_of
from levelproof.physics.types import Size
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.contents import ContentsError, check_numbers, level_fields
from levelproof.pipeline.store.fields import arrays_of, tree_of
from levelproof.pipeline.store.schema import FieldSpec


def column_fields(size: Size) -> dict[str, FieldSpec]:
    """The fields of a level of this size by the names of their columns; what a size has none of has no column."""
    return {field.name.rpartition("/")[2]: field for field in level_fields(size) if field.count}


def columns_for(level: Level) -> dict[str, pa.Array]:
    """The columns of these levels, a row for each."""
    arrays = arrays_of(level, "level/")
    return {name: _nested(np.moveaxis(arrays[of.name], -1, 0)) for name, of in column_fields(level.size).items()}


def levels_from(table: pa.Table) -> Level:
    """The levels in the rows of a table that `levelproof export --format parquet` wrote, level axis last.

    Any rows in any order will do, with `size` and the columns of levels; others are not looked at.

    Raises:
        UserError: rows are of several sizes, or columns are missing or hold what no level can.
    """
    try:
        sizes = table.column("size").unique().to_pylist()
        if len(sizes) != 1:
            raise UserError(f"The table has levels of the sizes {sizes}: choose rows of one size.")
        size = size_of(sizes[0])
        columns = {field.name: name for name, field in column_fields(size).items()}
        arrays = {of.name: _array(table, columns.get(of.name), of) for of in level_fields(size)}
        check_numbers(arrays, size)
    except (KeyError, ContentsError, ValueError, TypeError) as error:  # pyarrow's errors are some of these
        reason = str(error).strip("'\"").splitlines()[0]
        raise UserError(
            f"The table has not the columns of levels ({reason}): read them as they were written."
        ) from None
    return tree_of(Level, arrays, "level/")


def _nested(values: np.ndarray) -> pa.Array:
    """(level, ...) as one entry a level, of lists within lists.

    Not of fixed-size lists: pyarrow 26 dies of a segmentation fault where rows of those, in chunks, are filtered.
    """
    column = pa.array(np.ascontiguousarray(values).reshape(-1))
    for length in reversed(values.shape[1:]):
        column = pa.ListArray.from_arrays(np.arange(0, len(column) + 1, length, dtype=np.int32), column)
    return column


def _array(table: pa.Table, name: str | None, field: FieldSpec) -> np.ndarray:
    """The inverse, level axis last."""
    dtype, shape = np.dtype(field.dtype), (table.num_rows, *field.shape)
    if name is None:
        return np.moveaxis(np.zeros(shape, dtype), 0, -1)
    column = table.column(name)
    while pa.types.is_nested(column.type):
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks], column.type.value_type)
    if column.null_count or column.type != pa.from_numpy_dtype(dtype):
        raise ContentsError(f"{name} is not all of {dtype}")
    return np.ascontiguousarray(np.moveaxis(column.to_numpy().reshape(shape), 0, -1))
