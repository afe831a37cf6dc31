"""How a job goes on, from its split alone: by what its latest run tells there. Knows nothing of workers."""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from levelproof.configs.errors import readable
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.status import look
from levelproof.pipeline.outlet import has_reader
from levelproof.pipeline.store.events import events_of, runs_in
from levelproof.pipeline.store.layout import EVENTS
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.remote import as_typed
from levelproof.pipeline.words import duration, many

EVERY = 2.0  # s between looks
STALE = 30.0  # s after which a state is no more than the last that was told
SHOWN = 5  # failures
STATE = {"levels", "done", "solved", "env_steps", "rate", "left", "failures", "quarantined", "workers"}
FAILURE = {"unit", "cause"}


def watch(split: Path, as_json: bool, console: Console, every: float = EVERY) -> None:
    """Show how far a job is, again and again until no run is at work or nobody reads it; with `as_json`, an object a
    line.

    Raises:
        UserError: there is no split, or no run has told anything.
    """
    look(split, partial(print, file=sys.stderr))  # that there is a split
    if as_json:
        _follow(split, every, lambda facts: print(json.dumps(facts), flush=True))
    else:
        with Live(console=console, auto_refresh=False) as live:
            _follow(split, every, lambda facts: live.update(shown(facts), refresh=True))


def _follow(split: Path, every: float, show: Callable[[dict[str, Any]], None]) -> None:
    while True:
        facts = now(split)
        show(facts)
        if not facts["running"] or not has_reader():
            return
        time.sleep(every)


def now(split: Path) -> dict[str, Any]:
    """The facts that `watch` shows, as JSON's types.

    Raises:
        UserError: no run has told anything.
    """
    running, runs = is_written(split), runs_in(split)
    events = events_of(runs[-1]) if runs else []
    states = [event for event in events if event["event"] in ("progress", "ended") and event.keys() >= STATE]
    if not states:
        raise UserError(f"No run has told anything in {split / EVENTS} yet: `levelproof status` tells what is there.")
    state = states[-1]
    failed = [event for event in events if event["event"] in ("failed", "quarantined") and event.keys() >= FAILURE]
    done, solved = state["done"], state["solved"]
    return {
        "split": as_typed(split),
        "running": running and state["event"] != "ended",
        "age": round(max(0.0, time.time() - state["time"]), 1),  # s since it was told
        **{name: value for name, value in state.items() if name not in ("time", "event")},
        "solved_share": solved / done if done else None,
        "failed": [f"{of['unit']}: {of['cause']}" for of in failed[-SHOWN:]],
    }


def shown(facts: dict[str, Any]) -> Table:
    """For a terminal."""
    table = Table(box=None, show_header=False, pad_edge=False)
    share = "" if facts["solved_share"] is None else f", {facts['solved_share']:.1%} of them solved"
    left = "..." if facts["left"] is None else f"about {duration(facts['left'])} left"
    stale = f" (told {duration(facts['age'])} ago)" if facts["age"] > STALE else ""
    lines = {
        "split": facts["split"],
        "levels": f"{facts['done']:,} of {facts['levels']:,} committed{share}",
        "pace": f"{facts['rate']:,} env steps/s, {left}{stale}" if facts["running"] else "no run is at work",
        "failed attempts": f"{facts['failures']}, {many(facts['quarantined'], 'unit')} given up",
        **{
            f"workers on {host}": f"{of['count']}, the most silent for {duration(of['silent'] + facts['age'])}"
            for host, of in facts["workers"].items()
            if facts["running"]
        },
        **{f"failure {number}": text for number, text in enumerate(facts["failed"], 1)},
    }
    for name, text in lines.items():
        table.add_row(readable(name), readable(text))
    return table
