"""Names of files and folders of a split `{out}/{budget}/{size}`. Knows nothing of what is in them.

manifest/000000000000-000000000015.parquet          a fragment: the commit marker of a work unit
shards/000000000000-000000000015-5f0c2a9b.zarr      data of one attempt at that unit
experts/000000000000-000000000015-5f0c2a9b         experts of one attempt at that unit, if they are kept
quarantine/000000000000-000000000015.txt            why a unit was given up
job.json                                            what the last command wanted
.writer.lock, .commit.lock                          see pipeline/store/locks.py
"""

import re
import secrets
from pathlib import Path

from pipeline.errors import Failure

MANIFEST, SHARDS, EXPERTS, QUARANTINE = "manifest", "shards", "experts", "quarantine"
WRITER_LOCK, COMMIT_LOCK, JOB = ".writer.lock", ".commit.lock", "job.json"
DIGITS = 12  # of a level id in file names, so that names sort as ids do
UNIT = rf"(\d{{{DIGITS}}})-(\d{{{DIGITS}}})"
ATTEMPT = rf"{UNIT}-[0-9a-f]{{8}}"
DATA = re.compile(rf"{SHARDS}/{ATTEMPT}\.zarr|{EXPERTS}/{ATTEMPT}")


def split_path(out: str, budget: str, size: str) -> Path:
    return Path(out).expanduser() / budget / size


def unit_name(first: int, last: int) -> str:
    """Name of the work unit whose lowest and highest level ids these are."""
    return f"{first:0{DIGITS}d}-{last:0{DIGITS}d}"


def fragment_path(split: Path, unit: str) -> Path:
    return split / MANIFEST / f"{unit}.parquet"


def attempt_paths(split: Path, unit: str) -> tuple[Path, Path]:
    """New paths for a shard and for experts, used by no other attempt at this unit."""
    name = f"{unit}-{secrets.token_hex(4)}"
    return split / SHARDS / f"{name}.zarr", split / EXPERTS / name


def data_path(split: Path, name: str) -> Path:
    """Where the shard or the experts lie that a manifest names so.

    Raises:
        Failure: that is no name of either, or links lead elsewhere from there.
    """
    path = split / name
    if not DATA.fullmatch(name):
        raise Failure(
            f"The manifest of {split} names {name[:80]!r}, which can be neither a shard nor experts of this split: "
            "it was damaged or meant to do harm, so get the split again from where it came."
        )
    if path.resolve() != split.resolve() / name:
        raise Failure(f"The path {path} is a link to another place: put the data itself there.")
    return path


def ids_of(fragment: Path) -> tuple[int, int] | None:
    """The lowest and the highest level id in a fragment, by its name; None where the name does not tell."""
    found = re.fullmatch(rf"{UNIT}\.parquet", fragment.name)
    return (int(found[1]), int(found[2])) if found else None


def fragment_of(shard: Path) -> Path:
    """The fragment that can name this shard."""
    return fragment_path(shard.parent.parent, shard.stem.rpartition("-")[0])


def quarantine_path(split: Path, unit: str) -> Path:
    return split / QUARANTINE / f"{unit}.txt"
