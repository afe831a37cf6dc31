"""Shards: every bit is restored, damage is detected, and only requested arrays are read."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import SIZES, Level
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of
from levelproof.pipeline.store.formats import field_table
from levelproof.pipeline.store.packing import pack, unpack
from levelproof.pipeline.store.shard import Shard, stored_bytes, write_shard
from tests.pipeline.made import assert_same, made_fields, made_level, made_record

LEVELS = [5, 9, 12]


@pytest.fixture(scope="module")
def fields() -> dict[str, np.ndarray]:
    return made_fields("s", len(LEVELS))


@pytest.fixture
def shard(tmp_path: Path, fields: dict[str, np.ndarray]) -> Path:
    path = tmp_path / "000000000005-000000000012-abcd.zarr"
    write_shard(path, LEVELS, fields)
    return path


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(size=st.sampled_from(sorted(SIZES)), seed=st.integers(0, 2**32))
def test_read_restores_every_bit_of_every_field(tmp_path: Path, size: str, seed: int) -> None:
    fields = made_fields(size, len(LEVELS), seed)
    path = tmp_path / f"{size}-{seed}.zarr"
    if not path.exists():
        write_shard(path, LEVELS, fields)
    shard = Shard(path)
    assert shard.level_ids.tolist() == LEVELS
    assert_same(shard.read(), fields)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(sorted(SIZES)), st.integers(0, 2**32))
def test_unpack_inverts_pack(size: str, seed: int) -> None:
    fields = made_fields(size, len(LEVELS), seed)
    table = field_table(fields)
    levels_first = unpack(pack(fields, table), table)
    assert_same({name: np.moveaxis(x, 0, -1) for name, x in levels_first.items()}, fields)


def test_pack_refuses_values_that_do_not_fit(fields: dict[str, np.ndarray]) -> None:
    fields = fields | {"record/action": np.full_like(fields["record/action"], 300)}
    with pytest.raises(ValueError, match="record/action has values from 300"):
        pack(fields, field_table(fields))


def test_tree_of_inverts_arrays_of() -> None:
    level, record = made_level(), made_record()
    assert_same(arrays_of(tree_of(Level, arrays_of(level))), arrays_of(level))
    assert_same(arrays_of(tree_of(Record, arrays_of(record, "record/"), "record/")), arrays_of(record))


def test_same_bits_distinguishes_signed_zeros_and_accepts_nan() -> None:
    a = np.array([[0.0, np.nan, 1.0]], np.float32)
    assert same_bits(a, a.copy()).all()
    assert same_bits(a, -a).tolist() == [False, False, False]
    assert not same_bits(a, a.astype(np.float64)).any()


def test_read_opens_only_arrays_of_requested_fields(shard: Path, fields: dict[str, np.ndarray]) -> None:
    (shard / "dyn32/c/0/0/0").unlink()  # not needed below
    stored = Shard(shard).read(fields=["record/action", "level/role"])
    assert_same(stored, {name: fields[name] for name in ("level/role", "record/action")})


def test_shards_are_plain_zarr(shard: Path) -> None:
    group = zarr.open_group(shard, mode="r")
    assert {name for name, _ in group.arrays()} == {"dyn32", "dyn8", "act", "lvl32", "lvl8"}
    assert group["act"].shape == (len(LEVELS), 6, RECORD_STEPS)  # type: ignore[union-attr]
    assert group.attrs["format"] == "levelproof.shard"


def test_threads_write_the_same_bytes_as_one(shard: Path, fields: dict[str, np.ndarray], tmp_path: Path) -> None:
    others = [tmp_path / f"{number}" / shard.name for number in range(12)]
    with ThreadPoolExecutor(len(others)) as threads:
        list(threads.map(lambda path: write_shard(path, LEVELS, fields), others))
    contents = lambda path: {file.relative_to(path): file.read_bytes() for file in path.rglob("*") if file.is_file()}
    for other in others:
        assert contents(other) == contents(shard)


def test_write_shard_never_overwrites(shard: Path, fields: dict[str, np.ndarray]) -> None:
    with pytest.raises(FileExistsError):
        write_shard(shard, LEVELS, fields)


def test_stored_bytes_counts_every_file(shard: Path) -> None:
    assert stored_bytes(shard) == sum(path.stat().st_size for path in shard.rglob("*") if path.is_file())


@pytest.mark.parametrize("array", ["dyn32", "dyn8", "act", "lvl32", "lvl8"])
def test_read_detects_any_damaged_byte(shard: Path, array: str) -> None:
    file = next(path for path in (shard / array / "c").rglob("*") if path.is_file())
    whole = file.read_bytes()
    for at in range(0, len(whole), max(1, len(whole) // 7)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0x40]) + whole[at + 1 :])
        with pytest.raises(Failure, match=r"missing or damaged .* run `levelproof verify .* --repair` to regenerate"):
            Shard(shard).read()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(Failure, match="missing or damaged"):
        Shard(shard).read()


@pytest.mark.parametrize("file", ["zarr.json", "dyn8/zarr.json", "dyn8/c/0/0/0"])
def test_read_detects_a_missing_file(shard: Path, file: str) -> None:
    (shard / file).unlink()
    with pytest.raises(Failure, match="missing or damaged"):
        Shard(shard).read()


def test_shard_refuses_another_version(shard: Path) -> None:
    attributes = shard / "zarr.json"
    attributes.write_text(attributes.read_text().replace('"version": 2', '"version": 3'))
    with pytest.raises(Failure, match="has version 3, but this program reads 2"):
        Shard(shard)
