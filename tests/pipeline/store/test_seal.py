"""Sealing keeps rows and bits in fewer files, whatever processes read, commit or die concurrently."""

import errno
import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.store import manifest
from levelproof.pipeline.store import seal as sealing
from levelproof.pipeline.store.bounds import FRAGMENTS, MAX_ROWS, Bounded
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import fragment_of, fragment_path, new_attempt, unit_name
from levelproof.pipeline.store.leases import LeaseLost
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.manifest import begin_fragment, fragment_paths, read_manifest, write_fragment
from levelproof.pipeline.store.mend import take_out
from levelproof.pipeline.store.seal import CROWD, Piece, due, plan, seal
from levelproof.pipeline.store.shard import Shard
from tests.pace import patience
from tests.pipeline.command import wait_for_child
from tests.pipeline.made import commit_copy, made_job, made_result, made_split

UNITS = 6  # of two levels each, one of them solved


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("made"), [[Label.SOLVED, Label.UNSOLVED]] * UNITS)


@pytest.fixture
def split(made: Path, tmp_path: Path) -> Path:
    path = tmp_path / "data/128k/s"
    shutil.copytree(made, path)
    return path


def pieces(split: Path) -> list[Piece]:
    return list(map(Piece.of, read_manifest(split, []).fragments))


def whole(split: Path) -> dict[int, tuple]:
    """Return the rows, without their places, and every bit of their data."""
    found = {}
    for row in read_manifest(split).table.to_pylist():
        data = Shard(split / row["shard"]).read([row["row"]]) if row["shard"] else {}
        bits = tuple(values.tobytes() for values in data.values())
        found[row["level_id"]] = repr(row | {"shard": None, "row": None}), bits
    return found


def assert_tidy(split: Path, fragments: int) -> None:
    """Check that there are this many fragments and only the shards that they name."""
    assert len(fragment_paths(split)) == fragments
    assert len(list((split / "manifest").iterdir())) == fragments
    assert {f"shards/{path.name}" for path in (split / "shards").iterdir()} == read_manifest(split).shards


@pytest.mark.parametrize(("rows", "fragments"), [(4, 3), (6, 2), (100, 1)])
def test_seal_preserves_rows_and_bits(split: Path, made: Path, rows: int, fragments: int) -> None:
    for group in plan(pieces(split), rows):
        seal(split, group, rows_a_file=2)
    assert whole(split) == whole(made)
    assert_tidy(split, fragments)
    assert all(fragment.sealed for fragment in read_manifest(split).fragments)
    assert plan(pieces(split), rows) == []
    messages: list[str] = []
    clean(split, messages.append)
    assert not messages
    assert_tidy(split, fragments)


def test_seal_refuses_a_shard_with_altered_metadata(split: Path) -> None:
    shard = next((split / "shards").iterdir())
    group = shard / "zarr.json"
    assert '"frame_skip": 2' in group.read_text()
    group.write_text(group.read_text().replace('"frame_skip": 2', '"frame_skip": 3'))
    before = {path: path.is_file() and path.read_bytes() for path in split.rglob("*")}
    (piece,) = [piece for piece in pieces(split) if shard.stem.startswith(piece.path.stem)]
    with pytest.raises(Failure, match=r"its zarr.json is not what was committed"):
        seal(split, [piece])
    assert {path: path.is_file() and path.read_bytes() for path in split.rglob("*")} == before


def test_plan_merges_neighbours_and_keeps_large_fragments() -> None:
    def piece(first: int, rows: int, sealed: bool) -> Piece:
        return Piece(fragment_path(Path(), unit_name(first, first + rows - 1)), rows, sealed)

    small = [piece(i, 1, False) for i in range(5)]
    large, half, few = piece(10, 9, True), piece(20, 5, True), piece(30, 4, True)
    assert plan(small, 2) == [small[:2], small[2:4], small[4:]]
    assert plan([*reversed(small), large], 10) == [small]
    assert plan([large, half, few], 10) == []  # a sealed one alone
    assert plan([small[0], large, small[1]._replace(path=piece(40, 1, False).path), few], 10)[1][0] == few
    assert due(small, 6) == []
    assert due(small, 5) == [small]
    assert due(small, 2) == [small[:2], small[2:4]]
    crowd = [piece(100 + i, 1, False) for i in range(CROWD)]
    assert due([few, *crowd[1:]], 2 * CROWD) == []
    assert due([few, *crowd], 2 * CROWD) == [crowd]


def test_plan_never_groups_more_rows_than_a_fragment_may_have() -> None:
    parts = [Piece(fragment_path(Path(), unit_name(i, i)), MAX_ROWS // 2 - 1, False) for i in range(4)]
    last = Piece(fragment_path(Path(), unit_name(9, 9)), 3, False)
    assert plan([*parts, last], MAX_ROWS) == [parts[:2], [*parts[2:]], [last]]
    assert plan([parts[0], *parts[1:]], MAX_ROWS // 2) == [parts[:2], parts[2:]]
    assert plan([parts[0], parts[1]._replace(rows=MAX_ROWS)], MAX_ROWS) == [
        [parts[0]],
        [parts[1]._replace(rows=MAX_ROWS)],
    ]


def test_seal_refuses_fragments_that_readers_would_refuse(
    split: Path, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(split.rglob("*"))
    with pytest.raises(UserError, match=f"give --rows a number from 1 to {MAX_ROWS}"):
        seal_split(split, MAX_ROWS + 1, Console(quiet=True))
    with monkeypatch.context() as patched:
        patched.setattr(manifest, "Bounded", partial(Bounded, kind=replace(FRAGMENTS, max_rows=2 * UNITS - 1)))
        with pytest.raises(Failure, match=r"would be too large to be read .* use a smaller --rows"):
            seal(split, pieces(split))
    assert sorted(split.rglob("*")) == before
    assert whole(split) == whole(made)


def test_seal_refuses_after_another_writer_took_over(split: Path, made: Path) -> None:
    """The folder was deleted and created again, through another path, as another process would."""
    same = Path(os.path.relpath(split))
    with only_writer(split, print):
        shutil.rmtree(split)
        shutil.copytree(made, split)
        with only_writer(same, print):
            with pytest.raises(LeaseLost):
                seal(split, pieces(split))
            assert whole(split) == whole(made)
            assert_tidy(split, UNITS)
            seal(same, pieces(same))
    assert_tidy(split, 1)


def test_seal_removes_the_shard_of_a_fragment_that_a_repair_has_renamed(split: Path, made: Path) -> None:
    take_out(split, {1}, [], [])
    assert fragment_path(split, unit_name(0, 0)).exists()
    seal(split, pieces(split))
    expected = whole(made)
    del expected[1]
    assert whole(split) == expected
    assert_tidy(split, 1)


def test_seal_keeps_a_shard_that_another_fragment_names(split: Path) -> None:
    """A repair has died between its new fragment and the removal of the old one."""
    old = fragment_path(split, unit_name(0, 1))
    before, shards = old.read_bytes(), read_fragment(old)[0].digests
    take_out(split, {1}, [], [])
    old.write_bytes(before)
    seal(split, [piece for piece in pieces(split) if piece.path != old])
    assert shards
    assert all((split / name).exists() for name in shards)
    assert not list((split / "manifest").glob(".*"))


def test_units_commit_into_the_range_of_a_seal(split: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = made_job(str(split.parents[1]), "size=s")
    expected = whole(made)
    write = sealing.write_fragment

    def meanwhile(*args: Any, **how: Any) -> None:
        commit(job, split, WorkUnit((2, 3)), made_result([2, 3], [Label.SOLVED, Label.UNSOLVED]))
        write(*args, **how)

    fragment_path(split, unit_name(2, 3)).unlink()
    (shard,) = (split / "shards").glob(f"{unit_name(2, 3)}-*")
    shutil.rmtree(shard)
    with monkeypatch.context() as patched:
        patched.setattr(sealing, "write_fragment", meanwhile)
        seal(split, pieces(split))
    assert whole(split) == expected
    assert len(fragment_paths(split)) == 2
    seal(split, pieces(split))  # the new fragment has the range of the earlier one and replaces it
    assert whole(split) == expected
    assert_tidy(split, 1)


WRITES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}


def killed(split: Path, step: int) -> bool:
    """Clean and seal in a process that is killed after this many changes to the split; return whether it was."""
    if child := os.fork():
        code = wait_for_child(child)
        assert code in (0, -signal.SIGKILL), "it failed"
        return code == -signal.SIGKILL
    left = iter(range(step))

    def count(event: str, arguments: tuple) -> None:
        changes = event in WRITES or (event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        path = str(arguments[0]) if changes else ""
        ours = str(split) in path or not path.startswith("/")  # rmtree deletes a folder's contents by bare names
        if changes and ours and next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)

    try:
        sys.addaudithook(count)
        sealed(split, 100)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def sealed(split: Path, rows: int) -> None:
    clean(split, print)
    for group in plan(pieces(split), rows):
        seal(split, group, rows_a_file=2)


@pytest.mark.campaign
@pytest.mark.filterwarnings("ignore:os.fork")
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    steps=st.lists(
        st.one_of(
            st.tuples(st.just("commit"), st.integers(0, UNITS - 1)),
            st.tuples(st.just("seal"), st.sampled_from([2, 4, 100])),
            st.tuples(st.just("kill"), st.integers(0, 150)),
        ),
        min_size=3,
        max_size=7,
    )
)
def test_seal_survives_any_commits_and_kills(made: Path, tmp_path: Path, steps: list[tuple[str, int]]) -> None:
    split, there = tmp_path / "split", set()
    shutil.rmtree(split, ignore_errors=True)
    for folder in ("manifest", "shards"):
        (split / folder).mkdir(parents=True)
    expected = whole(made)
    for step, number in steps:
        if step == "kill":
            killed(split, number)
        elif step == "seal":
            sealed(split, number)
        elif 2 * number not in there:
            commit_copy(made, number, split)
            there |= {2 * number, 2 * number + 1}
        assert whole(split) == {level_id: expected[level_id] for level_id in there}
    sealed(split, 100)
    assert whole(split) == {level_id: expected[level_id] for level_id in there}
    assert_tidy(split, bool(there))


@pytest.mark.slow
def test_active_readers_survive_a_seal(split: Path, made: Path) -> None:
    """They see every level once at any time, and read its data wherever it lies."""
    expected, ended, passed = whole(made), threading.Event(), threading.Semaphore(0)

    def read() -> None:
        while not ended.is_set():
            rows = read_manifest(split).table.to_pylist()
            assert [row["level_id"] for row in rows] == list(expected)
            time.sleep(0.01)  # the data may move now
            for row in rows:
                if row["shard"]:
                    data = read_row(split, row)
                    assert tuple(values.tobytes() for values in data.values()) == expected[row["level_id"]][1]
            passed.release()

    def await_passes(count: int) -> None:
        while passed.acquire(blocking=False):  # those of before
            pass
        assert all(passed.acquire(timeout=patience(60)) for _ in range(count))

    with ThreadPoolExecutor() as threads:
        readers = [threads.submit(read) for _ in range(2)]
        try:
            for rows in (2, 5, 100):
                await_passes(1)
                sealed(split, rows)
            await_passes(3)  # of two readers, one began its last pass after the last seal
        finally:
            ended.set()
            for reader in readers:
                reader.result()
    assert_tidy(split, 1)


def test_read_manifest_lists_again_during_a_seal(split: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A listing is not atomic: it may miss the sealed fragment and the removed sources."""
    seal(split, pieces(split))
    listed, torn = manifest.entries, [True]
    monkeypatch.setattr(manifest, "entries", lambda *where: {} if torn and torn.pop() else listed(*where))
    assert read_manifest(split, []).level_ids.tolist() == list(whole(made))


def test_read_does_not_search_other_shards_for_damaged_rows(split: Path) -> None:
    row = next(row for row in read_manifest(split).table.to_pylist() if row["shard"])
    shutil.rmtree(split / row["shard"])
    with pytest.raises(Failure, match="missing or damaged"):
        read_row(split, row)


def test_seal_refuses_damaged_shards(split: Path, made: Path) -> None:
    shard = sorted((split / "shards").iterdir())[1]
    file = shard / "act/c/0/0/0"
    file.write_bytes(b"x" + file.read_bytes()[1:])
    before = sorted(split.rglob("*"))
    with pytest.raises(Failure, match="bytes of its array act are missing or have changed"):
        seal(split, pieces(split))
    assert sorted(split.rglob("*")) == before


def test_seal_keeps_encodings_apart(split: Path, made: Path) -> None:
    shard = next(iter((split / "shards").iterdir()))
    document = json.loads((shard / "zarr.json").read_text())
    document["attributes"]["task"]["frame_skip"] = 3  # another encoding of the same fields
    (shard / "zarr.json").write_text(json.dumps(document))
    fragment, rows = read_fragment(fragment_of(shard))
    attempt = new_attempt(split, fragment.path.stem)
    begin_fragment(attempt)
    write_fragment(attempt, rows, fragment.config_hash, fragment.config)
    for _ in range(2):
        seal(split, pieces(split))
        assert whole(split) == whole(made)
        assert_tidy(split, 1)
        assert len(read_manifest(split).shards) == 2


def test_seal_on_a_full_disk_changes_nothing(split: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = sorted(split.rglob("*"))
    for step in ("merge_shards", "disown", "write_fragment"):
        with monkeypatch.context() as patched:
            patched.setattr(sealing, step, full)
            with pytest.raises(OSError, match="No space left"):
                seal(split, pieces(split))
        assert sorted(split.rglob("*")) == before


class Stopped(Exception):
    """Raised to stop the seal."""


@pytest.mark.parametrize(("committed", "left"), [(False, 0), (True, UNITS + 1), (True, 1)])
def test_seal_stopped_at_any_file_loses_nothing(split: Path, made: Path, committed: bool, left: int) -> None:
    """Stop the seal before its commit, or after it with `left` fragments: before it removes one or, if last, shards."""
    fragment, asked = fragment_path(split, unit_name(0, 2 * UNITS - 1)), 0
    shards = len(list((split / "shards").iterdir()))

    def moved(count: int) -> None:
        nonlocal asked
        asked += not count  # before a file is opened or removed, no chunk has moved
        ready = fragment.exists() and len(fragment_paths(split)) == left
        if ready if committed else asked > UNITS:  # the seal has read all fragments by then
            raise Stopped

    with pytest.raises(Stopped):
        seal(split, pieces(split), moved)
    if committed:
        assert len(fragment_paths(split)) == left
        assert len(list((split / "shards").iterdir())) == shards + 1
    assert whole(split) == whole(made)
    clean(split, print)
    assert_tidy(split, 1 if committed else UNITS)
    assert whole(split) == whole(made)
