"""Events of runs, as JSON lines in one small file per run below the split's `events/`.

They are for users who watch a run: no commit and no reader of a split depends on them, so they may be deleted.
"""

import json
import re
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from os import DirEntry
from pathlib import Path
from typing import Any

from levelproof.pipeline.errors import LevelproofError
from levelproof.pipeline.store.files import remove, write
from levelproof.pipeline.store.layout import EVENTS, entries
from levelproof.pipeline.store.objects import get
from levelproof.pipeline.urls import is_remote

RUN = re.compile(rf"{EVENTS}/[0-9]{{8}}T[0-9]{{12}}-[0-9a-f]{{8}}\.jsonl")
HALF = re.compile(rf"{EVENTS}/\.[0-9]{{8}}T[0-9]{{12}}-[0-9a-f]{{8}}\.jsonl\.[0-9]+")  # from a dead run
KEPT = 20  # runs of a split
MAX_BYTES = 2**22  # of a file; ours reach a tenth of that

Event = Mapping[str, Any]  # `time` in s since 1970, `event`, and the event's data


def new_run(split: Path) -> Path:
    """Return the path for the events of a run that begins now, and delete the oldest runs.

    Names sort by time; if the clock went back, or is behind that of another machine, the new name still comes last.

    Raises:
        OSError: the write fails.
        UserError, StoreFailure: the store's request fails.
    """
    if not is_remote(split):
        (split / EVENTS).mkdir(exist_ok=True)
    runs = runs_in(split)
    for path in [*runs[: 1 - KEPT], *entries(split, EVENTS, HALF, DirEntry.is_file)]:
        remove(path)
    now = int(f"{datetime.now(UTC):%Y%m%d%H%M%S%f}")
    digits = f"{max([now, *(_number(path) + 1 for path in runs)]):020d}"
    return split / EVENTS / f"{digits[:8]}T{digits[8:]}-{secrets.token_hex(4)}.jsonl"


def _number(run: Path) -> int:
    """Return the digits of a run's time as a number; those after it need not be a time."""
    return int(run.name.partition("-")[0].replace("T", ""))


def runs_in(split: Path) -> list[Path]:
    """Return the event files of a split's runs, the latest last."""
    return sorted(entries(split, EVENTS, RUN, DirEntry.is_file))


def write_events(path: Path, events: Sequence[Event]) -> None:
    """Replace a run's file as a whole; failed writes are ignored, so that they do not end the run."""
    with suppress(OSError, LevelproofError):
        write(path, "".join(json.dumps(event) + "\n" for event in events).encode())


def events_of(path: Path) -> list[dict[str, Any]]:
    """Read a run's events, skipping invalid lines; none from a file larger than a run writes.

    Raises:
        UserError, StoreFailure: the store's request fails.
    """
    try:
        if not is_remote(path) and path.stat().st_size > MAX_BYTES:
            return []
        data = get(path, MAX_BYTES).data if is_remote(path) else path.read_bytes()
    except OSError:
        return []
    events = []
    for line in data.decode(errors="replace").splitlines():
        with suppress(ValueError, RecursionError):
            event = json.loads(line)
            if isinstance(event, dict) and isinstance(event.get("time"), float) and isinstance(event.get("event"), str):
                events.append(event)
    return events
