"""Status of a split: levels requested by the last command, committed and given up, and whether a run is active."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.job_note import NoteError, read_note
from levelproof.pipeline.store.layout import JOB, QUARANTINE
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.manifest import read_manifest, require_manifest
from levelproof.pipeline.store.quarantine import given_up
from levelproof.pipeline.store.runs import inside, runs_text
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many


def status(split: Path, as_json: bool, say: Callable[[str], None]) -> None:
    """Print the progress of `split`; `say` receives a message if checking for a run takes long.

    Raises:
        UserError: no split.
        Failure: a fragment is damaged.
    """
    facts = read_status(split, say)
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    counts = "".join(f", {count} {label}" for label, count in facts["labels"].items())
    print(f"{as_typed(split)}: {facts['done']:,} of {many(facts['wanted'], 'level')} committed{counts}.")
    for note, levels in facts["given_up"].items():
        print(f"Given up: {runs_text(levels)}, for the reason in {as_typed(split / QUARANTINE / note)}")
    if facts["running"]:
        print("A run is active.")
    elif facts["done"] < facts["wanted"]:
        print(f"No run is active. To resume: {facts['command']}")


def read_status(split: Path, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Collect the facts that `status` prints."""
    try:
        note = read_note(split)
    except (FileNotFoundError, NotADirectoryError):
        require_manifest(split, [])
        raise UserError(
            f"{as_typed(split)} has no {JOB}, which says what was requested: `levelproof inspect {quoted(split)}` "
            "shows what it has."
        ) from None
    except NoteError:
        raise UserError(f"The file {split / JOB} is damaged: run `levelproof generate` for this split again.") from None
    wanted = note.level_ids
    manifest = read_manifest(split, ["label"], compact=True)
    done = inside(manifest.level_ids, wanted)
    notes = {note.name: left for note, left in given_up(split, manifest.level_ids).items()}
    return {
        "split": as_typed(split),
        "wanted": int((wanted[:, 1] - wanted[:, 0] + 1).sum()),
        "done": int(done.sum()),
        "labels": dict(sorted(manifest.counts(done).items())),
        "quarantined": [*notes],
        "given_up": notes,  # first and last id of each range of levels, by note
        "running": is_written(split, say),
        "command": note.command,
    }
