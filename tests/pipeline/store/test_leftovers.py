"""Cleaning removes what dead attempts left, and nothing else, whatever its name."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs import unit
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.store import locks
from levelproof.pipeline.store.layout import attempt_of, unit_name
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.locks import committing
from levelproof.pipeline.store.manifest import fragment_paths
from tests.pace import patience, wait_until
from tests.pipeline.made import made_job, made_result


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """Return a split with levels 0 and 1 committed."""
    committed(tmp_path, 0)
    return tmp_path


def committed(split: Path, first: int) -> None:
    ids = [first, first + 1]
    commit(made_job(), split, WorkUnit(tuple(ids)), made_result(ids, [Label.SOLVED, Label.UNSOLVED]))


@pytest.fixture
def dead(split: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let an attempt die between its shard and its fragment; return its name."""

    def die(*_: object, **__: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(unit, "write_fragment", die)
        with pytest.raises(MemoryError):
            committed(split, 2)
    (begun,) = (split / "manifest").glob("*.begun")
    attempt = attempt_of(begun)
    assert (split / f"shards/{attempt}.zarr").is_dir()
    (split / "experts").mkdir()
    (split / f"experts/{attempt}.npz").touch()
    return attempt


def test_commit_skips_levels_of_an_unreported_commit(tmp_path: Path) -> None:
    """An attempt returned some of its levels, but its report was lost, so the whole unit was assigned again."""
    messages: list[str] = []
    for ids in [[0, 3], [0, 1, 2, 3], [0, 1, 2, 3]]:
        commit(made_job(), tmp_path, WorkUnit(tuple(ids)), made_result(ids, [Label.SOLVED] * len(ids)))
    assert clean(tmp_path, messages.append).level_ids.tolist() == [0, 1, 2, 3]
    assert [path.stem for path in fragment_paths(tmp_path)] == [unit_name(0, 3), unit_name(1, 2)]
    assert not messages, "a shard that no fragment names"


def everything(split: Path) -> set[Path]:
    return set(split.rglob("*"))


@pytest.fixture
def messages() -> list[str]:
    return []


def test_clean_removes_what_a_dead_attempt_left(split: Path, dead: str, messages: list[str]) -> None:
    note = split / "quarantine/.000000000004-000000000005.txt.123"
    note.parent.mkdir()
    half = {split / ".job.json.123", split / "manifest/.index.txt.123", note}
    for path in half:
        path.touch()
    before = everything(split)
    assert clean(split, messages.append).level_ids.tolist() == [0, 1]
    gone = {path for path in before if dead in path.as_posix()} | half
    assert everything(split) == before - gone
    assert not messages


@pytest.mark.usefixtures("dead")
def test_clean_keeps_files_of_others(split: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    clean(split, print)
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "mine").touch()
    attempt = "000000000004-000000000005-5f0c2a9b"
    folders = (
        "experts/mine",
        f"experts/{attempt}.npz.mine",
        f"shards/{attempt}.zarr.mine",
        "manifest/.ipynb_checkpoints",
        f"manifest/.{attempt[:-1]}0.begun",
    )
    for name in folders:
        (split / name).mkdir(parents=True)
        (split / name / "file").touch()
    for name in ("manifest/.DS_Store", "manifest/.nfs0000000000003a1b00000002", ".job.json.swp"):
        (split / name).touch()
    for name in (f"experts/{attempt}.npz", f"shards/{attempt}.zarr", "manifest/.linked"):
        (split / name).symlink_to(elsewhere)
    before = everything(split)
    (split / f"manifest/.{attempt}.begun").touch()  # only the links protect their targets
    assert clean(split, print).level_ids.tolist() == [0, 1]
    assert everything(split) == before
    assert (elsewhere / "mine").exists()


def test_clean_reports_unnamed_data_without_a_mark(split: Path, messages: list[str]) -> None:
    committed(split, 2)
    moved = fragment_paths(split)[0]
    (shard,) = (split / "shards").glob(f"{moved.stem}-*")
    moved.rename(split / "kept.parquet")
    before = everything(split)
    assert clean(split, messages.append).level_ids.tolist() == [2, 3]
    assert everything(split) == before
    (sentence,) = messages
    assert f"No fragment names {shard}: delete" in sentence


def test_clean_keeps_a_copy_made_during_a_commit(split: Path) -> None:
    """The copy has both the mark that the attempt began and the fragment that it became."""
    (shard,) = (split / "shards").iterdir()
    begun = split / f"manifest/.{attempt_of(shard)}.begun"
    begun.touch()
    clean(split, print)
    assert shard.is_dir()
    assert not begun.exists()


def test_clean_retries_failed_removals(split: Path, dead: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", lambda path, ignore_errors: None)
        clean(split, print)
    assert [path for path in everything(split) if dead in path.name]
    clean(split, print)
    assert not [path for path in everything(split) if dead in path.name]


def test_clean_stops_at_a_damaged_fragment(split: Path, dead: str) -> None:
    """Only that fragment names its data."""
    fragment_paths(split)[0].write_bytes(b"x")
    before = everything(split)
    with pytest.raises(Failure, match="is damaged"):
        clean(split, print)
    assert everything(split) == before


def test_clean_waits_for_a_running_commit(
    split: Path, dead: str, messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that outlives its killed run may be between its shard and its fragment."""
    monkeypatch.setattr(locks, "NOTICE", 0.0)
    with ThreadPoolExecutor() as other:
        with committing(split):
            cleaned = other.submit(clean, split, messages.append)
            wait_until(lambda: messages, 30, "no word about the wait")
            with pytest.raises(TimeoutError):
                cleaned.result(0.5)  # time in which it could remove the shard
            assert (split / f"shards/{dead}.zarr").is_dir()
        cleaned.result(patience(60))
    (sentence,) = messages
    assert "Waiting for a worker of an earlier run" in sentence
    assert not (split / f"shards/{dead}.zarr").exists()
