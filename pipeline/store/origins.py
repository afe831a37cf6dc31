"""Origins of levels that are not sampled from an id: a level file, a record of an imported folder, or a shard.

Such a level is in a shard once it has a witness, and in a seed file unless that was exported without levels. A level
file's id is derived from its content hash, so its random streams do not depend on where the file lies. A record's id is
its position in the folder.
"""

import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.remote import absolute
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.urls import as_typed

ASKED = ("content_hash", "file", "size", "shard", "row")  # columns that `origin_of` needs

RECORD = re.compile(r"(.+)/([^/]+)#(0|[1-9][0-9]{0,11})")


def can_be_noted(file: str) -> bool:
    """Whether `file` may be stored in a row: no control characters, no surrogates."""
    return not re.search("[\0-\x1f\x7f-\x9f\ud800-\udfff]", file)


class RecordPlace(NamedTuple):
    """Folder, array and row of an imported record; its string is the `file` of a manifest row."""

    folder: Path
    array: str
    row: int

    def __str__(self) -> str:
        return f"{self.folder}/{self.array}#{self.row}"


def place_of(file: str) -> RecordPlace | None:
    """Return the record that a row's `file` names; None: it names a level file."""
    match = RECORD.fullmatch(file)
    if not match or not os.path.isdir(f"{match[1]}/{match[2]}") or os.path.exists(file):  # `file` may be any string
        return None
    return RecordPlace(Path(match[1]), match[2], int(match[3]))


class Origin(NamedTuple):
    """Location of one level, and the content that it must have."""

    content_hash: str
    file: str  # absolute path, or the string of a `RecordPlace`
    size: str
    split: str = ""  # absolute path of a split with the level
    shard: str = ""  # path below the split; empty: no shard has the level
    row: int = 0
    level_id: int = 0  # id of the level in the split
    command: str = ""  # of the row to regenerate; empty: a new row


def origin_of(split: Path, row: Mapping[str, Any]) -> Origin:
    """Return the origin of a manifest row that has the columns ASKED and `level_id`."""
    where, level_id = as_typed(absolute(split)), row["level_id"]
    origin = Origin(row["content_hash"], row["file"] or "", row["size"], where, level_id=level_id)
    return origin._replace(shard=row["shard"], row=row["row"]) if row["shard"] else origin


def origins_of(split: Path, level_ids: Collection[int]) -> dict[int, Origin]:
    """Return the origins of levels of a split, by level id.

    Raises:
        UserError: the file, or the imported folder, of a level without a shard is missing.
        Failure: a fragment is damaged.
    """
    rows = read_manifest(split, ASKED, list(level_ids)).table.to_pylist()
    origins = {row["level_id"]: origin_of(split, row) for row in rows}
    files = [] if is_seed(split) else [origin.file for origin in origins.values() if not origin.shard]
    missing = [file for file in files if not place_of(file) and not os.path.isfile(file)]
    if missing:
        more = f" and {len(missing) - 1} more" if missing[1:] else ""
        lacking = f"No shard of {split} has the level of {missing[0]}{more}, and its"
        if record := RECORD.fullmatch(missing[0]):
            raise UserError(f"{lacking} folder is missing: put the imported folder {record[1]} back.")
        raise UserError(
            f"{lacking} file is missing: put it back, or label the files where they are now with "
            "levelproof generate level_files=FOLDER."
        )
    return origins


def require_same_levels(split: Path, origins: Mapping[int, Origin], done: Collection[int]) -> None:
    """Refuse levels whose ids belong to different levels in the split: among many files, two may share an id.

    Raises:
        UserError: an id collides.
        Failure: a fragment is damaged.
    """
    if not origins or not len(done):
        return
    table = read_manifest(split, ["content_hash", "file"], list(done)).table
    for row in table.to_pylist():
        here = origins[row["level_id"]]
        if row["content_hash"] != here.content_hash:
            raise UserError(
                f"The levels of {here.file} and {row['file']} happen to have the same id, {row['level_id']}: "
                "label one of them in another folder, with out=NAME."
            )
