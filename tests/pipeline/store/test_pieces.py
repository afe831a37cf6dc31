"""Piece cache: returns the bytes that were put or none, within its bound, whatever processes and disks do."""

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.pipeline.errors import StoreFailure
from levelproof.pipeline.store.pieces import CHECKSUM, PARTS, PieceCache

MAX_LENGTH = 40  # bytes of a piece


def piece(n: int) -> bytes:
    return bytes((n * 7 + i) % 256 for i in range(1 + (n * 13) % MAX_LENGTH))


def stored_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.tuples(st.sampled_from(["put", "read", "flip", "cut"]), st.integers(0, 7), st.booleans())),
    most=st.integers(0, 200),
)
def test_piece_cache_returns_right_bytes(steps: list, most: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("cache")
    caches = [PieceCache(folder, most) for _ in range(2)]  # two processes
    for what, n, which in steps:
        name, whole = f"name-{n}", piece(n)
        if what == "put":
            caches[which].put(name, whole)
            assert stored_bytes(folder) <= most + 2 * (most // PARTS + MAX_LENGTH + CHECKSUM)
        elif what == "read":
            found = caches[which].read(name, n % 3, len(whole))
            assert found in (None, whole[n % 3 :])
        elif (path := folder / name).exists():  # the disk lost bytes; then the processes restart
            data = path.read_bytes()
            path.write_bytes(data[:-1] if what == "cut" else bytes([data[0] ^ 1]) + data[1:])
            caches = [PieceCache(folder, most) for _ in range(2)]
            assert caches[which].read(name, 0, len(whole)) is None
            assert not path.exists()


def test_piece_cache_keeps_recently_used_pieces(tmp_path: Path) -> None:
    cache = PieceCache(tmp_path, 10 * (100 + CHECKSUM))
    for n in range(10):
        cache.put(str(n), bytes(100))
        path = tmp_path / str(n)
        path.touch()
        old = path.stat().st_mtime_ns - (100 - n) * 10**9
        os.utime(path, ns=(old, old))
    assert cache.read("0", 0, 1) == b"\0"  # used again
    cache.put("new", bytes(100))
    left = {path.name for path in tmp_path.iterdir()}
    assert {"0", "new"} <= left
    assert not {"1", "2"} & left


def test_piece_cache_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    (tmp_path / ".name-0.0a1b2c3d").write_bytes(bytes(500))
    os.utime(tmp_path / ".name-0.0a1b2c3d", (0, 0))
    cache = PieceCache(tmp_path, 400)
    assert cache.read("name-0", 0, 1) is None
    cache.put("name-0", b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["name-0"]


def test_piece_cache_reads_a_folder_that_it_cannot_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    PieceCache(tmp_path, 400).put("name", b"piece")
    os.utime(tmp_path / "name", (0, 0))
    (tmp_path / "damaged").write_bytes(bytes(CHECKSUM + 1))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EROFS, "read-only")

    for module, name in (os, "utime"), (os, "unlink"), (Path, "unlink"):
        monkeypatch.setattr(module, name, refuse)
    cache = PieceCache(tmp_path, 400)
    assert cache.read("name", 0, 5) == b"piece"
    assert cache.read("damaged", 0, 1) is None


def test_piece_cache_explains_an_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreFailure, match=r"Cannot write to the cache folder .* LEVELPROOF_CACHE_DIR"):
        PieceCache(tmp_path / "file" / "cache", 100).put("name", b"x")
