"""Notes of the last command: read as written, with any changed byte detected."""

import os
from contextlib import suppress
from pathlib import Path

import pytest

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store import files, job_note
from levelproof.pipeline.store.job_note import NoteError, note_density, note_job, read_note
from levelproof.pipeline.store.layout import JOB
from tests.pipeline.made import made_job

COMMAND = ["levelproof", "regenerate", "where=label = 'solved'"]


@pytest.fixture
def split(tmp_path: Path) -> Path:
    note_job(tmp_path, made_job(), COMMAND, [(0, 7), (9, 9)])
    return tmp_path


def test_read_note_returns_what_was_noted(split: Path) -> None:
    note = read_note(split)
    assert note.command == "levelproof regenerate 'where=label = '\"'\"'solved'\"'\"''"
    assert note.level_ids.tolist() == [[0, 7], [9, 9]]
    assert note.config == made_job().results
    assert note.intact


def test_note_job_refuses_a_note_that_no_command_would_read(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (split / JOB).read_bytes()
    monkeypatch.setattr(job_note, "MAX_BYTES", len(before) + 100)
    note_job(split, made_job(), COMMAND, [(0, 7), (9, 9), (11, 11)])
    with pytest.raises(
        UserError, match=r"no command reads more than [\d,]+, because the levels are in 100 runs of ids"
    ):
        note_job(split, made_job(), COMMAND, [(2 * i, 2 * i) for i in range(100)])
    assert read_note(split).level_ids.tolist() == [[0, 7], [9, 9], [11, 11]]


def test_note_is_on_the_disk_before_it_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repair deletes data right after noting what is lost."""
    flushed: list[tuple[Path, bool]] = []
    monkeypatch.setattr(files, "flush_entry", lambda path: flushed.append((path, (tmp_path / JOB).exists())))
    note_job(tmp_path, made_job(), COMMAND, [(0, 7)])
    ((new, there), *others) = flushed
    assert (new.parent, new.name.startswith(f".{JOB}."), there) == (tmp_path, True, False)
    assert others == [(tmp_path, True)]


def test_note_density_changes_the_command(split: Path) -> None:
    note_density(split, "witness", 16)
    note_density(split, "resume", 32)
    note = read_note(split)
    assert note.command.endswith(" density=resume key_every=32")
    assert "witness" not in note.command
    assert note.intact
    assert note.level_ids.tolist() == [[0, 7], [9, 9]]
    note_job(split, made_job(), ["levelproof", "grow", "a.parquet", "-o", "128k/s", "density=full"], [(0, 7)])
    note_density(split, "witness", 16)
    assert read_note(split).command == "levelproof grow a.parquet -o 128k/s density=witness key_every=16"
    note_job(split, made_job(), ["levelproof", "import", "there"], [(0, 7)])
    note_density(split, "witness", 16)
    assert read_note(split).command == "levelproof import there"


def test_read_note_detects_any_changed_byte(split: Path) -> None:
    whole = (split / JOB).read_bytes()
    for at in range(0, len(whole), 13):
        (split / JOB).write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 7]) + whole[at + 1 :])
        with suppress(NoteError):
            assert not read_note(split).intact, at
    for other in (whole[:-1], whole + b"\n", whole.replace(b": ", b":")):
        (split / JOB).write_bytes(other)
        assert not read_note(split).intact


def test_read_note_drops_settings_that_do_not_match_their_hash(split: Path) -> None:
    text = (split / JOB).read_text()
    (split / JOB).write_text(text.replace('"budget": 131072', '"budget": 131073').replace("128000", "128001"))
    assert read_note(split).config is None


@pytest.mark.parametrize("text", ["", "[]", "7", "[" * 100_000, '{"command": 1, "level_ids": []}', "\0", '"\ud800"'])
def test_read_note_refuses_invalid_notes(tmp_path: Path, text: str) -> None:
    (tmp_path / JOB).write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(NoteError):
        read_note(tmp_path)


def test_read_note_refuses_pipes_and_large_files(split: Path) -> None:
    note = split / JOB
    large = lambda: (note.touch(), os.truncate(note, 2**30))
    for put in (lambda: os.mkfifo(note), lambda: note.symlink_to("/dev/zero"), large):
        note.unlink()
        put()
        with pytest.raises(NoteError):
            read_note(split)


def test_read_note_replaces_control_characters(split: Path) -> None:
    note_job(split, made_job(), ["\x1b[2J"], [])
    assert read_note(split).command == "'?[2J'"
