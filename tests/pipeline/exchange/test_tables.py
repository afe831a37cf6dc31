"""`columns_for` and `levels_from`: levels as table columns and back, in every bit."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from levelproof.levelgen.level import SIZES, Level, size_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.tables import column_fields, columns_for, levels_from
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.fields import arrays_of, same_bits
from tests.pipeline.made import made_level

EMPTY = "8-8-0-0"  # no joints, no thrusters


def table_of(level: Level, size: str) -> pa.Table:
    columns = columns_for(level)
    return pa.table({"size": [size] * len(columns["gravity"]), **columns})


@pytest.mark.parametrize("size", [*SIZES, EMPTY])
def test_levels_from_restores_every_bit_from_a_file(size: str, tmp_path) -> None:
    level = empty_level(size_of(EMPTY), 3) if size == EMPTY else made_level(size)
    pq.write_table(table_of(level, size), tmp_path / "levels.parquet", use_dictionary=False)
    back = arrays_of(levels_from(pq.read_table(tmp_path / "levels.parquet")))
    for name, values in arrays_of(level).items():
        assert same_bits(values, back[name]).all(), name


@pytest.mark.parametrize("size", SIZES)
def test_column_names_are_unique(size: str) -> None:
    fields = column_fields(SIZES[size])
    assert {field.name for field in fields.values()} == set(arrays_of(made_level(size), "level/"))
    assert not set(fields) & set(COLUMNS.names)


def test_levels_from_accepts_selected_and_reordered_rows() -> None:
    level = made_level("s", 5)
    table = table_of(level, "s")
    chosen = arrays_of(levels_from(pa.concat_tables([table.slice(3, 2), table.slice(1, 1)])))
    for name, values in arrays_of(level).items():
        assert same_bits(values[..., [3, 4, 1]], chosen[name]).all(), name


def test_levels_from_accepts_rows_filtered_from_many_chunks() -> None:
    """A file with many row groups reads as many chunks."""
    level = made_level("m", 40)
    chunks = pa.concat_tables([table_of(level, "m").slice(first, 8) for first in range(0, 40, 8)])
    even = arrays_of(levels_from(chunks.filter(pa.array([i % 2 == 0 for i in range(40)]))))
    for name, values in arrays_of(level).items():
        assert same_bits(values[..., ::2], even[name]).all(), name


def test_levels_from_rejects_tables_without_valid_levels() -> None:
    table = table_of(made_level("s"), "s")
    other = lambda name, column: table.set_column(table.schema.get_field_index(name), name, column)
    ragged = pa.array([[1.0], [2.0, 3.0], []], pa.list_(pa.float32()))
    for wrong in (
        table.drop_columns(["role"]),
        table.drop_columns(["size"]),
        other("role", pa.array([[9] * 7] * 3, pa.list_(pa.int32()))),
        other("role", pa.array([[1.0] * 7] * 3)),
        other("gravity", ragged),
        other("size", pa.array(["m"] * 3)),
        other("size", pa.array(["s", "m", "s"])),
        other("size", pa.array(["x"] * 3)),
        table.slice(0, 0),
    ):
        with pytest.raises(UserError, match=r"^The table (has levels of sizes|lacks valid level columns) "):
            levels_from(wrong)
