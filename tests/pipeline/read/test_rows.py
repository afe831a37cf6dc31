"""`read_rows`: arrays in row order across shards, and after a seal has moved levels."""

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store.fields import same_bits
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.shard import Shard
from tests.pipeline.made import made_split

UNITS = [[Label.SOLVED] * 2, [Label.UNSOLVED, Label.SOLVED, Label.SOLVED], [Label.SOLVED] * 4]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("made"), UNITS)


@pytest.fixture
def split(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "s"))


def replace_column(split: Path, column: str, values: list) -> None:
    """Replace a column of the split's first fragment."""
    fragment = min((split / "manifest").glob("*.parquet"))
    table = pq.read_table(fragment)
    at = table.schema.get_field_index(column)
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array(values, table.schema.types[at])), fragment)


def witnessed(split: Path) -> pa.Table:
    table = read_manifest(split).table
    return table.filter(pc.is_valid(table["shard"]))  # pyright: ignore[reportAttributeAccessIssue]


def test_read_rows_keeps_row_order_across_shards(split: Path) -> None:
    rows = witnessed(split).take([7, 0, 3, 1, 6, 0])
    assert len(set(rows["shard"].to_pylist())) == 3
    batch = read_rows(split, rows)
    for i, row in enumerate(rows.to_pylist()):
        alone = Shard(split / row["shard"]).read([row["row"]])
        assert batch.keys() == alone.keys()
        assert all(same_bits(batch[name][..., i : i + 1], alone[name]).all() for name in alone)


def test_read_rows_returns_only_requested_fields(split: Path) -> None:
    batch = read_rows(split, witnessed(split), ["record/reward", "level/role"])
    assert {name: x.shape[-1] for name, x in batch.items()} == {"record/reward": 8, "level/role": 8}


def test_read_rows_follows_levels_moved_by_a_seal(split: Path) -> None:
    """The split is as after a seal: the manifest names another shard for the levels."""
    rows = witnessed(split)
    before = read_rows(split, rows)
    old, new = Path(rows["shard"][0].as_py()), Path("shards/000000000000-000000000001-ffffffff.zarr")
    shutil.move(split / old, split / new)
    replace_column(split, "shard", [str(new)] * 2)
    after = read_rows(split, rows)
    assert all(same_bits(after[name], before[name]).all() for name in before)


def test_read_rows_reports_a_missing_shard(split: Path) -> None:
    rows = witnessed(split)
    shutil.rmtree(split / rows["shard"][0].as_py())
    with pytest.raises(Failure, match="missing or damaged"):
        read_rows(split, rows)


def test_read_rows_rejects_a_row_of_another_level(split: Path) -> None:
    for wrong in ([1, 0], [-1, -1], [0, 2]):
        replace_column(split, "row", wrong)
        with pytest.raises(Failure, match="does not have the levels that the manifest lists"):
            read_rows(split, witnessed(split).slice(0, 2))
