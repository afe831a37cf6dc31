"""Live view of a job, from the events that its latest run writes to the split; needs no contact with workers."""

import json
import math
import sys
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from levelproof.configs.errors import readable
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.status import read_status
from levelproof.pipeline.outlet import has_reader
from levelproof.pipeline.store.event_files import events_of, runs_in
from levelproof.pipeline.store.layout import EVENTS
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.progress_bar import LINE_EVERY
from levelproof.pipeline.tables import folded
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import duration, many

INTERVAL = 2.0  # s between refreshes
STALE = 30.0  # s; an older state of a run is shown with its age
SHOWN = 5  # maximum number of failures shown
STATE = {"levels", "done", "solved", "env_steps", "rate", "left", "failures", "quarantined", "unsealed", "workers"}
FAILURE = {"unit", "cause"}


def watch(split: Path, as_json: bool, console: Console, interval: float = INTERVAL) -> None:
    """Show a job's progress, refreshed until no run is active or the output has no reader.

    A file or pipe gets another table every LINE_EVERY seconds; with `as_json`, one JSON object per refresh.

    Raises:
        UserError: no split, or no run has logged its state.
    """
    read_status(split, partial(print, file=sys.stderr))  # raises if there is no split
    if as_json:
        _follow(split, interval, lambda facts: print(json.dumps(facts), flush=True))
    elif console.is_interactive:
        with Live(console=console, auto_refresh=False) as live:
            _follow(split, interval, lambda facts: live.update(progress_table(facts), refresh=True))
    else:  # a live view would appear only when it ends
        _follow(split, interval, lambda facts: console.print(progress_table(facts)), LINE_EVERY)


def _follow(split: Path, interval: float, show: Callable[[dict[str, Any]], None], shown_every: float = 0.0) -> None:
    """Read a job's progress every `interval` s, and show it every `shown_every` s and when the run has ended."""
    shown_at = -math.inf
    before = [path for path in runs_in(split) if any(event["event"] == "ended" for event in events_of(path))]
    while True:
        facts = read_progress(split, before)
        if not facts["running"] or time.monotonic() - shown_at >= shown_every:
            shown_at = time.monotonic()
            show(facts)
        if not facts["running"] or not has_reader():
            return
        time.sleep(interval)


def read_progress(split: Path, before: Collection[Path] = ()) -> dict[str, Any]:
    """Collect the facts that `watch` shows, as JSON types.

    If the latest run is one of those that had ended `before`, but the split is being written, another one begins.

    Raises:
        UserError: no run has logged its state.
    """
    running, runs = is_written(split), runs_in(split)
    events = events_of(runs[-1]) if runs else []
    states = [event for event in events if event["event"] in ("progress", "ended") and event.keys() >= STATE]
    if not states:
        raise UserError(
            f"No run has logged its state in {split / EVENTS} yet: run `levelproof status` for what is committed."
        )
    state = states[-1]
    failed = [event for event in events if event["event"] in ("failed", "quarantined") and event.keys() >= FAILURE]
    done, solved = state["done"], state["solved"]
    return {
        "split": as_typed(split),
        "running": running and (state["event"] != "ended" or runs[-1] in before),
        "age": round(max(0.0, time.time() - state["time"]), 1),  # s since the run logged it
        **{name: value for name, value in state.items() if name not in ("time", "event")},
        "solved_share": solved / done if done else None,
        "failed": [f"{event['unit']}: {event['cause']}" for event in failed[-SHOWN:]],
    }


def progress_table(facts: dict[str, Any]) -> Table:
    """Format the facts for a terminal."""
    table = Table(box=None, show_header=False, pad_edge=False)
    share = "" if facts["solved_share"] is None else f", {facts['solved_share']:.1%} of them solved"
    left = "..." if facts["left"] is None else f"about {duration(facts['left'])} left"
    pace = f"{facts['rate']:,} env steps/s, {left}"
    if facts["unsealed"]:
        pace = f"sealing, {many(facts['unsealed'], 'group')} of fragments left"
    stale = f" (logged {duration(facts['age'])} ago)" if facts["age"] > STALE else ""
    lines = {
        "split": facts["split"],
        "levels": f"{facts['done']:,} of {facts['levels']:,} committed{share}",
        "pace": f"{pace}{stale}" if facts["running"] else "no run is active",
        "failed attempts": f"{facts['failures']}, {many(facts['quarantined'], 'unit')} given up",
        **{
            f"workers on {host}": f"{workers['count']}, longest silent for {duration(workers['silent'] + facts['age'])}"
            for host, workers in facts["workers"].items()
            if facts["running"]
        },
        **{f"failure {number}": text for number, text in enumerate(facts["failed"], 1)},
    }
    for name, text in lines.items():
        table.add_row(readable(name), readable(text))
    return folded(table)
