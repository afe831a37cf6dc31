"""Watching a run through its split, until it ends."""

import io
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from levelproof.experts.labels import Label
from levelproof.pipeline.look import watch as module
from levelproof.pipeline.look.watch import progress_table, read_progress, watch
from levelproof.pipeline.store.event_files import new_run, write_events
from levelproof.pipeline.store.locks import only_writer
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_split

STATE = {"levels": 8, "done": 4, "solved": 3, "env_steps": 100, "rate": 12, "left": 7, "failures": 1}
STATE |= {"quarantined": 0, "unsealed": 0}


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED]])


def state(event: str, age: float = 0.0, **changes: object) -> dict:
    workers = {"a machine": {"count": 2, "silent": 1.5}}
    return {"time": time.time() - age, "event": event, "workers": workers, **STATE, **changes}


def between_refreshes(monkeypatch: pytest.MonkeyPatch, *happenings: Callable[[], None]) -> None:
    """Let these happen one after another, each while `watch` sleeps; it must not sleep more often."""
    left = iter(happenings)
    monkeypatch.setattr(module.time, "sleep", lambda _: next(left)())


def test_watch_prints_a_line_per_refresh_until_the_run_ends(
    split: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = new_run(split)
    failed = {"time": time.time(), "event": "failed", "unit": "0-1", "cause": "of this one"}
    write_events(run, [failed, state("progress")])
    later = [state("progress", done=6), state("ended", done=8)]
    with only_writer(split, print):
        between_refreshes(monkeypatch, *(partial(write_events, run, [failed, event]) for event in later))
        watch(split, True, Console())
    facts = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [state["running"] for state in facts] == [True, True, False]
    assert [state["done"] for state in facts] == [4, 6, 8]
    assert (facts[0]["solved_share"], facts[0]["failed"], facts[0]["rate"]) == (0.75, ["0-1: of this one"], 12)


def test_watch_prints_each_table_into_a_pipe_at_once(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, pipe = new_run(split), io.StringIO()
    write_events(run, [state("progress")])

    def end() -> None:
        assert "4 of 8 committed" in pipe.getvalue()
        write_events(run, [state("ended", done=8)])

    with only_writer(split, print):
        between_refreshes(monkeypatch, end)
        watch(split, False, Console(file=pipe))
    assert "8 of 8 committed" in pipe.getvalue()


def test_watch_waits_for_a_run_that_has_logged_nothing_yet(
    split: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cleans the split and starts workers; the latest events are those of the run that it continues."""
    write_events(new_run(split), [state("ended", age=60.0)])
    later = new_run(split)
    events = [state("progress", done=5), state("ended", done=8)]
    with only_writer(split, print):
        between_refreshes(monkeypatch, *(partial(write_events, later, [event]) for event in events))
        watch(split, True, Console())
    facts = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [state["running"] for state in facts] == [True, True, False]
    assert [state["done"] for state in facts] == [4, 5, 8]


def test_watch_tells_dead_runs_from_silent_ones(split: Path) -> None:
    write_events(new_run(split), [state("progress", age=600.0)])
    assert not read_progress(split)["running"]
    with only_writer(split, print):
        facts = read_progress(split)
        assert facts["running"]
        console = Console(width=200)
        with console.capture() as captured:
            console.print(progress_table(facts))
    text = captured.get()
    with console.capture() as sealing:
        console.print(progress_table(facts | {"unsealed": 2}))
    assert "sealing, 2 groups of fragments left" in sealing.get()
    assert "4 of 8 committed, 75.0% of them solved" in text
    assert "logged 10 min ago" in text
    assert "2, longest silent for 10 min" in text


def test_watch_prints_causes_without_control_characters(split: Path) -> None:
    failed = {"time": 1.0, "event": "failed", "unit": "0-1", "cause": "KeyError: [b] of [/a]\x1b[2J"}
    damaged = {"time": 1.0, "event": "failed"}
    write_events(new_run(split), [failed, damaged, state("ended")])
    done = here(["status", str(split), "--watch"], split)
    assert done.returncode == 0, done.stderr
    assert "0-1: KeyError: [b] of [/a]?[2J" in done.stdout


def test_watch_refuses_a_split_without_events(split: Path) -> None:
    assert_refused(here(["status", str(split), "--watch"], split), 2, "No run has logged its state")
    write_events(new_run(split), [{"time": 1.0, "event": "progress"}])  # damaged
    assert_refused(here(["status", str(split), "--watch"], split), 2, "No run has logged its state")
