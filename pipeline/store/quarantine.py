"""Notes that say why units were given up.

A note is removed once all of its levels are committed, whichever units they belong to by then.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from levelproof.pipeline.errors import LevelproofError
from levelproof.pipeline.store import objects
from levelproof.pipeline.store.files import remove, write
from levelproof.pipeline.store.layout import NOTE, QUARANTINE, entries, ids_of, quarantine_path, unit_name
from levelproof.pipeline.store.leases import require_served
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.store.runs import runs, without
from levelproof.pipeline.urls import is_remote

MAX_LINE = 2**20  # bytes of a note's first line, which names its levels
LEVELS = re.compile(r"Levels: ([0-9]{1,12}-[0-9]{1,12}(?:, [0-9]{1,12}-[0-9]{1,12})*)\n")


def give_up(split: Path, level_ids: Sequence[int], reason: str) -> None:
    """Note why these levels (ascending) were given up.

    Raises:
        LeaseLost: this process works for a writer that no longer has the split.
        OSError, UserError, StoreFailure: as `files.write`.
    """
    require_served(split)
    note = quarantine_path(split, unit_name(level_ids[0], level_ids[-1]))
    if not is_remote(split):
        note.parent.mkdir(exist_ok=True)
    levels = ", ".join(f"{first}-{last}" for first, last in runs(level_ids))
    write(note, f"Levels: {levels}\n{reason}".encode())


def given_up(split: Path, done: np.ndarray) -> dict[Path, list[tuple[int, int]]]:
    """Return the notes with levels that are not among `done` (ascending ids), with these levels as runs.

    Raises:
        UserError, StoreFailure: the store's request fails.
    """
    return {note: left for note, left in _left(split, done).items() if left}


def drop_notes(split: Path, done: np.ndarray) -> None:
    """Remove the notes whose levels are all `done` (ascending ids). Raises as `files.remove`."""
    for note, left in _left(split, done).items():
        if not left:
            remove(note)


def _left(split: Path, done: np.ndarray) -> dict[Path, list[tuple[int, int]]]:
    """Return every note's levels that are not done, as runs."""
    notes = sorted(entries(split, QUARANTINE, NOTE, os.DirEntry.is_file))
    return dict(zip(notes, at_once(split, lambda note: _left_of(note, done), notes), strict=True))


def _left_of(note: Path, done: np.ndarray) -> list[tuple[int, int]]:
    """Return a note's levels that are not done, as runs; the note is read unless its name shows that all are done."""
    by_name = [ids_of(note)]
    left = without(by_name, done)
    return without(_levels_in(note) or by_name, done) if left else left


def _levels_in(note: Path) -> list[tuple[int, int]]:
    """Read the runs of level ids in a note's first line; none if it cannot be read."""
    try:
        if is_remote(note):
            data, _ = objects.begin_of(note, MAX_LINE)
        else:
            with note.open("rb") as file:
                data = file.readline(MAX_LINE)
    except (OSError, LevelproofError):
        return []
    match = LEVELS.match(data.decode(errors="replace"))
    pairs = [run.split("-") for run in match[1].split(", ")] if match else []
    return [(int(first), int(last)) for first, last in pairs]
