"""Names of a split's files and folders, as docs/storage.md shows them; knows nothing of their contents."""

import os
import re
import secrets
from collections.abc import Callable, Iterable
from os import DirEntry
from pathlib import Path
from typing import NamedTuple

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.remote import INDEX, fragments_in, names_in
from levelproof.pipeline.urls import BUCKETS, is_remote

MANIFEST, SHARDS, EXPERTS, QUARANTINE, CHECKPOINTS = "manifest", "shards", "experts", "quarantine", "checkpoints"
FOLDERS = MANIFEST, SHARDS, EXPERTS, QUARANTINE, CHECKPOINTS
WRITER_LOCK, COMMIT_LOCK, JOB = ".writer.lock", ".commit.lock", "job.json"
EVENTS = "events"  # of runs; no commit and no reader depends on them
DIGITS = 12  # of a level id in file names, so that names sort as ids do
UNIT = rf"([0-9]{{{DIGITS}}})-([0-9]{{{DIGITS}}})"
ATTEMPT = rf"{UNIT}-[0-9a-f]{{8}}"
# Paths below the split:
FRAGMENT = re.compile(rf"{MANIFEST}/{UNIT}\.parquet")
BEGUN = re.compile(rf"{MANIFEST}/\.{ATTEMPT}\.begun")
DATA = re.compile(rf"{SHARDS}/{ATTEMPT}\.zarr|{EXPERTS}/{ATTEMPT}\.npz")
CHECKPOINT = re.compile(rf"{CHECKPOINTS}/{UNIT}\.paused")  # experts in training
CHECKPOINT_BEGUN = re.compile(rf"{CHECKPOINTS}/\.{UNIT}\.paused\.[0-9]+")
NOTE = re.compile(rf"{QUARANTINE}/{UNIT}\.txt")  # why a unit was given up
NOTE_BEGUN = re.compile(rf"{QUARANTINE}/\.{UNIT}\.txt\.[0-9]+")
JOB_BEGUN = re.compile(rf"\.{re.escape(JOB)}\.[0-9]+")  # ends in the PID of its writer
INDEX_FILE = re.compile(rf"{MANIFEST}/{re.escape(INDEX)}")
INDEX_BEGUN = re.compile(rf"{MANIFEST}/\.{re.escape(INDEX)}\.[0-9]+")


class Attempt(NamedTuple):
    """Paths to which one attempt at a unit writes; unique to it, except the fragment's."""

    fragment: Path
    begun: Path  # the attempt's mark: written first, and renamed to the fragment by its commit
    shard: Path
    experts: Path


def split_path(out: str, budget: str, size: str) -> Path:
    return Path(out).expanduser() / budget / size


def unit_name(first: int, last: int) -> str:
    """Name the work unit with these lowest and highest level ids."""
    return f"{first:0{DIGITS}d}-{last:0{DIGITS}d}"


def fragment_path(split: Path, unit: str) -> Path:
    return split / MANIFEST / f"{unit}.parquet"


def new_attempt(split: Path, unit: str) -> Attempt:
    name = f"{unit}-{secrets.token_hex(4)}"
    return Attempt(
        fragment_path(split, unit),
        split / MANIFEST / f".{name}.begun",
        split / SHARDS / f"{name}.zarr",
        split / EXPERTS / f"{name}.npz",
    )


def unit_ids(data: Path) -> tuple[int, int]:
    """Parse the lowest and highest level id of a unit from the name of its shard or experts."""
    first, last, _ = attempt_of(data).split("-")
    return int(first), int(last)


def data_paths(split: Path) -> list[Path]:
    """List all shards and experts of a split, also those that no fragment names."""
    return [*entries(split, SHARDS, DATA, DirEntry.is_dir), *entries(split, EXPERTS, DATA, DirEntry.is_file)]


def made_within(data: Iterable[Path], fragment: Path) -> list[Path]:
    """Select shards and experts whose units lie within a fragment's range of level ids, judging by names."""
    first, last = ids_of(fragment)
    return [path for path in data if first <= unit_ids(path)[0] and unit_ids(path)[1] <= last]


def attempt_of(path: Path) -> str:
    """Parse the attempt's name from a path that matches `BEGUN` or `DATA`."""
    match = re.search(ATTEMPT, path.name)
    assert match, path
    return match[0]


def data_path(split: Path, name: str) -> Path:
    """Return the path of the shard or experts that a manifest names.

    Raises:
        Failure: the name is invalid, or links lead elsewhere.
    """
    path = split / name
    if not DATA.fullmatch(name):
        raise Failure(
            f"The manifest of {split} names {name[:80]!r}, which can be neither a shard nor experts of this split: "
            "it is damaged or malicious, so get the split again from its source."
        )
    if path.resolve() != split.resolve() / name:
        raise Failure(f"The path {path} leads elsewhere through a link: put the data itself there.")
    return path


def begun_path(data: Path) -> Path:
    """Return the path of the mark of the attempt that made this shard or these experts."""
    return data.parent.parent / MANIFEST / f".{attempt_of(data)}.begun"


def checkpoint_path(split: Path, unit: str) -> Path:
    return split / CHECKPOINTS / f"{unit}.paused"


def ids_of(path: Path) -> tuple[int, int]:
    """Parse the lowest and highest level id from the name of a fragment, a checkpoint or a unit's note."""
    first, last = path.stem.split("-")
    return int(first), int(last)


def entries(split: Path, folder: str, paths: re.Pattern[str], is_kind: Callable[..., bool]) -> dict[Path, int]:
    """List the entries of a split's folder that match `paths` and a kind (`DirEntry.is_file`, `is_dir`).

    There are none if the folder does not exist. Links match no kind. The values identify the file that has the path
    now: its inode number, or a hash of the store's metadata.
    """
    if is_remote(split):
        if folder == MANIFEST:
            listed = {path: hash(about) for path, about in fragments_in(split / folder).items()}
        else:
            listed = dict.fromkeys(names_in(split / folder) if split.parts[0] in BUCKETS else [], 0)
        return {path: number for path, number in listed.items() if paths.fullmatch(os.path.join(folder, path.name))}
    if not (split / folder).is_dir():
        return {}
    with os.scandir(split / folder) as listing:
        return {
            split / folder / entry.name: entry.inode()
            for entry in listing
            if paths.fullmatch(os.path.join(folder, entry.name)) and is_kind(entry, follow_symlinks=False)
        }


def fragment_files(split: Path) -> set[tuple[Path, int]]:
    """Return the committed fragments and what identifies their files, which any command that writes changes."""
    return {*entries(split, MANIFEST, FRAGMENT, DirEntry.is_file).items()}


def fragment_of(shard: Path) -> Path:
    """Return the path of the only fragment that can name this shard."""
    return fragment_path(shard.parent.parent, shard.stem.rpartition("-")[0])


def quarantine_path(split: Path, unit: str) -> Path:
    return split / QUARANTINE / f"{unit}.txt"
