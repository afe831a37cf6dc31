"""Tables in mapped files of the cache folder: the rows that were shared, from one copy, or none at all."""

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow as pa
import pytest

from levelproof.pipeline.runtime import CACHE_VARIABLE
from levelproof.pipeline.store import mapped, pieces
from levelproof.pipeline.store.mapped import find_table, share_table

TABLE = pa.table(
    {"id": pa.array(range(1000), pa.int32()), "text": ["a", None, "bcd", ""] * 250, "bytes": [b"\x00\xff", b""] * 500}
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(mapped, "MIN_BYTES", 0)
    return tmp_path / "cache" / mapped.FOLDER


def only(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_shared_table_is_found_and_lies_in_its_file(folder: Path) -> None:
    assert find_table("one") is None
    before = pa.total_allocated_bytes()
    for table in (share_table("one", TABLE), find_table("one")):
        assert table is not None
        assert table.equals(TABLE)
        assert table.schema.metadata is None
        assert pa.total_allocated_bytes() - before < TABLE.nbytes / 2, "its rows are in memory of this process"
        assert table["id"].num_chunks == 1
    assert find_table("two") is None
    assert not stat.S_IMODE(folder.stat().st_mode) & (stat.S_IWGRP | stat.S_IWOTH)


def test_small_table_stays_in_memory(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped, "MIN_BYTES", TABLE.nbytes + 1)
    assert share_table("one", TABLE) is TABLE
    assert not folder.exists()


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def replace_by_another(path: Path) -> None:
    share_table("another", TABLE.slice(1))
    (other,) = {*path.parent.iterdir()} - {path}
    other.replace(path)


def link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


@pytest.mark.parametrize("damage", [truncate, empty, flip, replace_by_another, link])
def test_damaged_or_foreign_file_is_written_again(folder: Path, damage) -> None:
    share_table("one", TABLE)
    path = only(folder)
    damage(path)
    assert find_table("one") is None
    assert share_table("one", TABLE).equals(TABLE)
    found = find_table("one")
    assert found is not None
    assert found.equals(TABLE)


def test_file_with_other_rows_is_written_again() -> None:
    share_table("one", TABLE.slice(1))
    assert share_table("one", TABLE).equals(TABLE)
    found = find_table("one")
    assert found is not None
    assert found.equals(TABLE)


def test_equal_table_is_not_written_again(folder: Path) -> None:
    share_table("one", TABLE)
    inode = only(folder).stat().st_ino
    share_table("one", TABLE)
    assert only(folder).stat().st_ino == inode


def test_concurrent_writers_do_not_conflict(folder: Path) -> None:
    with ThreadPoolExecutor(8) as threads:
        for table in threads.map(lambda _: share_table("one", TABLE), range(64)):
            assert table.equals(TABLE)
    assert only(folder).suffix == mapped.SUFFIX, "a temporary file is left"


def test_table_stays_in_memory_if_its_file_cannot_be_written(folder: Path) -> None:
    folder.parent.mkdir()
    folder.write_text("not a folder")
    assert share_table("one", TABLE) is TABLE
    assert find_table("one") is None


def test_table_is_not_shared_in_a_folder_of_others(folder: Path) -> None:
    folder.parent.mkdir()
    folder.parent.chmod(0o777)
    assert share_table("one", TABLE) is TABLE
    assert not folder.exists()


def test_least_recently_used_tables_are_deleted_and_stay_readable(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = share_table("one", TABLE)
    old = only(folder)
    os.utime(old, (1, 1))
    monkeypatch.setattr(mapped, "MOST", int(2.5 * old.stat().st_size))
    assert pieces.KEPT_SHARE * 2.5 > 2
    share_table("two", TABLE)
    share_table("three", TABLE)
    assert len([*folder.iterdir()]) == 2
    assert find_table("one") is None
    assert first.equals(TABLE)
