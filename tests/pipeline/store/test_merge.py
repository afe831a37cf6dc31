"""Merging shards without decoding: every bit is preserved, in few files, and damage is refused."""

from pathlib import Path

import numpy as np
import pytest
import zarr

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.fields import same_bits
from levelproof.pipeline.store.merge import Place, merge_shards
from levelproof.pipeline.store.shard import Shard, write_shard
from tests.pipeline.made import made_fields


@pytest.fixture
def parts(tmp_path: Path) -> list[Path]:
    """Write three shards, of levels 0 to 4, 5 to 9 and 10 to 14."""
    paths = [tmp_path / f"{first}.zarr" for first in (0, 5, 10)]
    for seed, path in enumerate(paths):
        first = 5 * seed
        write_shard(path, range(first, first + 5), made_fields("s", 5, seed))
    return paths


def of_all(parts: list[Path]) -> list[Place]:
    return [Place(path, row, int(path.stem) + row) for path in parts for row in range(5)]


@pytest.mark.parametrize("rows_a_file", [1, 4, 15, None])
def test_merge_shards_preserves_every_bit(tmp_path: Path, parts: list[Path], rows_a_file: int | None) -> None:
    once, again = tmp_path / "once.zarr", tmp_path / "again.zarr"
    merge_shards(once, of_all(parts)[::2], rows_a_file=rows_a_file)
    merge_shards(
        again, [Place(once, 1, 2), Place(parts[0], 3, 3), Place(once, 7, 14)], rows_a_file=2
    )  # levels 2, 3, 14
    assert Shard(once).level_ids.tolist() == list(range(0, 15, 2))
    assert Shard(again).level_ids.tolist() == [2, 3, 14]
    whole = [Shard(path).read() for path in parts]
    expected = {name: np.concatenate([fields[name] for fields in whole], -1) for name in whole[0]}
    for shard, levels in (once, range(0, 15, 2)), (again, [2, 3, 14]):
        for name, values in Shard(shard).read().items():
            assert same_bits(values, expected[name][..., levels]).all(), name
    (last,) = Shard(again).read([2])["record/action"].T[:, 0, :1].tolist()
    assert last == expected["record/action"].T[14, 0, :1].tolist()


def test_merge_shards_writes_few_plain_zarr_files(tmp_path: Path, parts: list[Path]) -> None:
    path = tmp_path / "merged.zarr"
    merge_shards(path, of_all(parts), rows_a_file=4)
    array = zarr.open_array(path, path="dyn32", mode="r")
    assert array.shards == (4, *array.shape[1:])
    assert array.chunks == (1, *array.shape[1:])
    assert len([file for file in (path / "dyn32" / "c").rglob("*") if file.is_file()]) == 4
    whole = np.concatenate([np.asarray(zarr.open_array(part, path="dyn32", mode="r")[:]) for part in parts])
    assert (np.asarray(array[:]) == whole).all()


def test_merge_shards_refuses_damage(tmp_path: Path, parts: list[Path]) -> None:
    file = parts[1] / "act/c/0/0/0"
    whole = file.read_bytes()
    for at in (7, len(whole) // 2, len(whole) - 20, len(whole) - 1):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(Failure, match=r"5\.zarr is missing or damaged \(bytes of its array act"):
            merge_shards(tmp_path / f"{at}.zarr", of_all(parts))
    file.write_bytes(whole[:30])
    with pytest.raises(Failure, match="a file of its array act is cut off"):
        merge_shards(tmp_path / "short.zarr", of_all(parts))
    file.unlink()
    with pytest.raises(Failure, match="FileNotFoundError"):
        merge_shards(tmp_path / "gone.zarr", of_all(parts))


def test_merge_shards_refuses_different_fields(tmp_path: Path, parts: list[Path]) -> None:
    other = tmp_path / "m.zarr"
    write_shard(other, [20], made_fields("m", 1))
    with pytest.raises(Failure, match="have different fields"):
        merge_shards(tmp_path / "merged.zarr", [*of_all(parts), Place(other, 0, 20)])


@pytest.mark.parametrize(
    "wrong", [Place(Path("5.zarr"), 1, 5), Place(Path("5.zarr"), 5, 10), Place(Path("5.zarr"), -1, 9)]
)
def test_merge_shards_refuses_a_row_of_another_level(tmp_path: Path, parts: list[Path], wrong: Place) -> None:
    with pytest.raises(Failure, match=rf"row {wrong.row} is not level {wrong.level_id}, which the manifest names"):
        merge_shards(tmp_path / "merged.zarr", [wrong._replace(shard=tmp_path / wrong.shard)])


def test_read_refuses_a_missing_file_of_a_merged_shard(tmp_path: Path, parts: list[Path]) -> None:
    path = tmp_path / "merged.zarr"
    merge_shards(path, of_all(parts), rows_a_file=4)
    (path / "lvl32/c/1/0").unlink()
    Shard(path).read([0, 14])
    with pytest.raises(Failure, match="missing or damaged"):
        Shard(path).read([5])
