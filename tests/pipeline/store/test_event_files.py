"""Event files: few, replaced as a whole, and harmless whatever their contents."""

from pathlib import Path

import pytest

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.event_files import KEPT, events_of, new_run, runs_in, write_events
from levelproof.pipeline.store.layout import EVENTS
from levelproof.pipeline.store.split import locked


def test_write_events_replaces_a_runs_file_and_new_run_removes_old_ones(tmp_path: Path) -> None:
    (tmp_path / EVENTS).mkdir()
    foreign = tmp_path / EVENTS / "mine.txt"
    foreign.touch()
    for path in (new_run(tmp_path) for _ in range(KEPT + 4)):
        write_events(path, [])
    path = new_run(tmp_path)
    write_events(path, [{"time": 1.0, "event": "started"}])
    write_events(path, [{"time": 1.0, "event": "started"}, {"time": 2.0, "event": "ended"}])
    (tmp_path / EVENTS / f".{path.name}.123").touch()  # of a dead run
    last = new_run(tmp_path)
    write_events(last, [])
    assert [event["event"] for event in events_of(path)] == ["started", "ended"]
    assert len(runs_in(tmp_path)) == KEPT
    assert {entry.name for entry in (tmp_path / EVENTS).iterdir()} == {
        "mine.txt",
        *(run.name for run in runs_in(tmp_path)),
    }


def test_new_run_comes_last_although_the_clock_went_back(tmp_path: Path) -> None:
    """Watchers take the last one for the current run."""
    (tmp_path / EVENTS).mkdir()
    for stamp in ("20260101T000000000000", "20991231T235959999999"):
        (tmp_path / EVENTS / f"{stamp}-ffffffff.jsonl").touch()
    for _ in range(3):
        path = new_run(tmp_path)
        write_events(path, [])
        assert runs_in(tmp_path)[-1] == path


def test_write_events_ignores_failed_writes(tmp_path: Path) -> None:
    write_events(tmp_path / "gone" / "run.jsonl", [{"time": 1.0, "event": "started"}])


def test_events_of_skips_invalid_lines(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    deep = "[" * 100_000
    path.write_bytes(b'\xff\n{"time": 1.0, "event": "progress"}\n{"time": "now", "event": 3}\n3\n' + deep.encode())
    assert [event["event"] for event in events_of(path)] == ["progress"]
    path.write_bytes(b"x" * 2**23)
    assert events_of(path) == events_of(tmp_path / "none") == []


def test_locked_refuses_a_linked_events_folder(tmp_path: Path) -> None:
    (tmp_path / "split").mkdir()
    (tmp_path / "split" / EVENTS).symlink_to(tmp_path)
    with pytest.raises(UserError, match="is a link"), locked(tmp_path / "split", print):
        pass
