"""Files that a command opens in an untrusted split: whatever is planted under their names, no other file changes."""

import os
from pathlib import Path

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.store import leases
from levelproof.pipeline.store.disk import NotRegular, regular
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.layout import COMMIT_LOCK, JOB, MANIFEST, WRITER_LOCK, begun_path, data_paths
from levelproof.pipeline.store.leases import LeaseLost
from levelproof.pipeline.store.locks import committing, only_writer
from levelproof.pipeline.store.pieces import PieceCache
from levelproof.pipeline.store.remote import INDEX
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_split
from tests.pipeline.planted import MINE, PLANTED, never_hangs, profile

__all__ = ["never_hangs", "profile"]  # fixtures


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return made_split(tmp_path / "data", [[Label.SOLVED], [Label.UNSOLVED]])


@pytest.mark.slow
@pytest.mark.parametrize("lock", [WRITER_LOCK, COMMIT_LOCK])
@pytest.mark.parametrize("kind", PLANTED)
def test_seal_refuses_an_irregular_lock(split: Path, profile: Path, lock: str, kind: str) -> None:
    (split / lock).unlink(missing_ok=True)
    PLANTED[kind](split / lock, profile)
    assert_refused(here(["seal", str(split)], split), 2, f"{split / lock} must be a regular file", "remove it")
    assert profile.read_bytes() == MINE
    assert not profile.with_name("new").exists()
    facts = here(["status", str(split), "--json"], split)
    assert facts.returncode == 0, facts.stderr
    assert '"running": false' in facts.stdout
    if kind == "pipe" and lock == WRITER_LOCK:
        assert "Traceback" not in here(["verify", str(split)], split).stderr


@pytest.mark.parametrize("kind", PLANTED)
def test_workers_end_when_their_lock_is_replaced(split: Path, profile: Path, kind: str) -> None:
    with only_writer(split, print):
        (split / WRITER_LOCK).unlink()
        PLANTED[kind](split / WRITER_LOCK, profile)
        with pytest.raises(LeaseLost), committing(split):
            pytest.fail("it would commit")
    assert not leases._served


@pytest.mark.parametrize("kind", ["link", "link to nothing", "hard link", "pipe", "socket"])
def test_temporary_files_replace_what_has_their_name(split: Path, profile: Path, kind: str) -> None:
    names = [f".{JOB}.{os.getpid()}", f"{MANIFEST}/.{INDEX}.{os.getpid()}"]
    for name in names:
        PLANTED[kind](split / name, profile)
    done = here(["seal", str(split)], split)
    assert done.returncode == 0, done.stderr
    assert (split / MANIFEST / INDEX).read_text().endswith(".parquet\n")
    PLANTED[kind](split / f".note.{os.getpid()}", profile)
    write(split / "note", b"text")
    assert (split / "note").read_bytes() == b"text"
    assert profile.read_bytes() == MINE
    assert not profile.with_name("new").exists()
    assert not [name for name in (*names, f".note.{os.getpid()}") if os.path.lexists(split / name)]


@pytest.mark.parametrize("kind", ["link", "link to nothing", "pipe"])
def test_seal_refuses_an_irregular_mark(split: Path, profile: Path, kind: str) -> None:
    before = profile.stat().st_mtime_ns
    (shard,) = data_paths(split)
    PLANTED[kind](begun_path(shard), profile)
    assert_refused(here(["seal", str(split)], split), 2, f"{begun_path(shard)} must be a regular file")
    assert profile.stat().st_mtime_ns == before
    assert not profile.with_name("new").exists()
    assert data_paths(split) == [shard]


def test_regular_truncates_only_regular_files(tmp_path: Path, profile: Path) -> None:
    (tmp_path / "name").hardlink_to(profile)
    with pytest.raises(NotRegular, match="name must be a regular file"), open(tmp_path / "name", "wb", opener=regular):
        pass
    assert profile.read_bytes() == MINE
    profile.unlink()
    with open(tmp_path / "name", "wb", opener=regular) as file:
        file.write(b"new")
    assert (tmp_path / "name").read_bytes() == b"new"


def test_piece_cache_does_not_follow_links(tmp_path: Path, profile: Path) -> None:
    cache = PieceCache(tmp_path / "cache", 1000)
    cache.put("name", b"piece")
    (tmp_path / "cache/name").rename(tmp_path / "piece")
    (tmp_path / "cache/name").symlink_to(tmp_path / "piece")
    assert cache.read("name", 0, 5) is None
    cache.put("name", b"piece")
    assert cache.read("name", 0, 5) == b"piece"
