"""Why units were given up: a note for each, until it is committed."""

from pathlib import Path

from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.layout import QUARANTINE, quarantine_path
from levelproof.pipeline.store.remote import is_remote, names_in
from levelproof.pipeline.urls import BUCKETS


def give_up(split: Path, unit: str, reason: str) -> Path:
    """Note why; where. Raises as `files.write`."""
    note = quarantine_path(split, unit)
    if not is_remote(split):
        note.parent.mkdir(exist_ok=True)
    write(note, reason.encode())
    return note


def given_up(split: Path) -> list[Path]:
    """The notes of a split.

    Raises:
        UserError, StoreFailure: the store refuses.
    """
    folder = split / QUARANTINE
    if not is_remote(split):
        return sorted(folder.glob("*.txt"))
    return sorted(names_in(folder)) if split.parts[0] in BUCKETS else []
