"""`job.json`: the levels that the last command requested and those already in the split, to detect losses."""

import hashlib
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levelproof.configs.schema import JobConfig, hash_of
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.bounds import unread
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.layout import JOB
from levelproof.pipeline.store.objects import get
from levelproof.pipeline.urls import is_remote

MAX_BYTES = 2**26  # of a file; a run of level ids takes about 25, and each level of a level file is a run
DIGEST = "sha256"  # JSON key
CONTINUED = ["generate"], ["regenerate"], ["grow"]  # commands that set a density and continue a split


class NoteError(ValueError):
    """A note is invalid; the message is the end of a sentence."""


@dataclass(frozen=True)
class JobNote:
    """Levels and settings that a split should have."""

    command: str  # the last one
    level_ids: np.ndarray  # (run, 2): first and last of each run of ids, ascending
    config: dict[str, Any] | None  # the settings that decide results
    intact: bool  # every byte is as written


def note_job(split: Path, job: JobConfig, command: Sequence[str], wanted: Sequence[tuple[int, int]]) -> None:
    """Record durably the runs of level ids that should exist after this command, as first and last of each.

    Raises:
        UserError: these are more runs than a note can have; nothing is written.
    """
    note = {
        "command": shlex.join(command),
        "level_ids": [list(run) for run in wanted],
        "config_hash": job.hash,
        "config": job.results,
    }
    _store(split, note)


def _store(split: Path, note: dict[str, Any]) -> None:
    data = _text(note).encode()
    if len(data) > MAX_BYTES:
        raise UserError(
            f"The note {split / JOB} would have {len(data):,} bytes, but no command reads more than {MAX_BYTES:,}, "
            f"because the levels are in {len(note['level_ids']):,} runs of ids: make fewer of them in one split."
        )
    write(split / JOB, data, durable=True)


def note_density(split: Path, density: str, key_every: int) -> None:
    """Change the noted command to the density that is stored now, so that it can resume."""
    if (note := sound_note(split)) is None or shlex.split(note.command)[1:2] not in CONTINUED:
        return
    arguments = [arg for arg in shlex.split(note.command) if arg.partition("=")[0] not in ("density", "key_every")]
    arguments += [f"density={density}", f"key_every={key_every}"]
    content = json.loads(_bytes(split / JOB)) | {"command": shlex.join(arguments)}
    del content[DIGEST]
    _store(split, content)


def read_note(split: Path) -> JobNote:
    """Read the note of a split.

    Raises:
        FileNotFoundError: there is none.
        NoteError: it is invalid.
        DataUnread: this machine cannot read it.
    """
    data = _bytes(split / JOB)
    try:
        text = data.decode()
        note = json.loads(text)
        runs = np.array(sorted(note["level_ids"]), np.int64).reshape(-1, 2)
        command, config = note["command"], note.get("config")
        if not isinstance(command, str) or (runs[:, 0] > runs[:, 1]).any():
            raise ValueError
        if not isinstance(config, dict) or hash_of(config) != note["config_hash"]:
            config = None
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise NoteError(type(error).__name__) from None
    content = {name: value for name, value in note.items() if name != DIGEST}
    command = "".join(c if c.isprintable() else "?" for c in command)  # control characters would reach terminals
    return JobNote(command, runs, config, text == _text(content))


def _bytes(path: Path) -> bytes:
    if not is_remote(path):
        if not path.exists():
            raise FileNotFoundError(path)
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise NoteError(f"it is not a regular file of at most {MAX_BYTES:,} bytes")
    try:
        return get(path, MAX_BYTES).data if is_remote(path) else path.read_bytes()
    except FileNotFoundError:
        raise
    except (OSError, MemoryError) as error:
        raise unread(path, error) or NoteError(type(error).__name__) from None


def sound_note(split: Path) -> JobNote | None:
    """Read the note of a split; None if it is damaged or missing. Raise DataUnread if this machine cannot read it."""
    try:
        note = read_note(split)
    except (FileNotFoundError, NoteError):
        return None
    return note if note.intact else None


def _text(note: dict[str, Any]) -> str:
    """Return the whole file: one line, its digest last."""
    digest = hashlib.sha256(json.dumps(note).encode()).hexdigest()
    return json.dumps(note | {DIGEST: digest}) + "\n"
