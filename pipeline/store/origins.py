"""Where levels are that no id makes: in a level file or a record of an imported folder, and once they have a witness
in a shard.

The id of a level file's level is made of its content hash: it has the same random streams wherever its file lies. That
of a record is its place in the folder.
"""

import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.remote import absolute, as_typed

ASKED = ("content_hash", "file", "size", "shard", "row")  # columns that tell a level's origin


RECORD = re.compile(r"(.+)/([^/]+)#(0|[1-9][0-9]{0,11})")


def can_be_noted(file: str) -> bool:
    """Whether a row may have this as its `file`: text that can be written, and that no terminal obeys."""
    return not re.search("[\0-\x1f\x7f-\x9f\ud800-\udfff]", file)


class RecordPlace(NamedTuple):
    """Where an imported record is; as text, the `file` of its row."""

    folder: Path
    array: str
    row: int

    def __str__(self) -> str:
        return f"{self.folder}/{self.array}#{self.row}"


def place_of(file: str) -> RecordPlace | None:
    """The record that a row's `file` names; None: it names a level file."""
    found = RECORD.fullmatch(file)
    if not found or not os.path.isdir(f"{found[1]}/{found[2]}") or os.path.exists(file):  # of any text
        return None
    return RecordPlace(Path(found[1]), found[2], int(found[3]))


class Origin(NamedTuple):
    """Where one level is, and what it has to be."""

    content_hash: str
    file: str  # absolute path, or that of a record's `RecordPlace`
    size: str
    split: str = ""  # absolute path, where a row has the level
    shard: str = ""  # path below the split; empty: none has it
    row: int = 0
    level_id: int = 0  # there


def origin_of(split: Path, row: Mapping[str, Any]) -> Origin:
    """Of a row of a split's manifest, with the columns ASKED."""
    found = Origin(row["content_hash"], row["file"] or "", row["size"], as_typed(absolute(split)))
    if not row["shard"]:
        return found
    return found._replace(shard=row["shard"], row=row["row"], level_id=row["level_id"])


def origins_of(split: Path, level_ids: Collection[int]) -> dict[int, Origin]:
    """Of these levels of a split, by their ids.

    Raises:
        UserError: the file of one without a shard is gone.
        Failure: a fragment is damaged.
    """
    rows = read_manifest(split, ASKED, list(level_ids)).table.to_pylist()
    found = {row["level_id"]: origin_of(split, row) for row in rows}
    gone = [of.file for of in found.values() if not of.shard and not place_of(of.file) and not os.path.isfile(of.file)]
    if gone:
        more = f" and {len(gone) - 1} more" if gone[1:] else ""
        raise UserError(
            f"No shard of {split} has the level of {gone[0]}{more}, and its file is gone: put it back, "
            "or label the files where they are now with levelproof generate level_files=FOLDER."
        )
    return found


def require_same_levels(split: Path, origins: Mapping[int, Origin], done: Collection[int]) -> None:
    """Refuse levels whose ids other ones have in the split: two contents in some ten thousand share one.

    Raises:
        UserError: there is such a level.
        Failure: a fragment is damaged.
    """
    if not origins or not len(done):
        return
    table = read_manifest(split, ["content_hash", "file"], list(done)).table
    for row in table.to_pylist():
        here = origins[row["level_id"]]
        if row["content_hash"] != here.content_hash:
            raise UserError(
                f"The levels of {here.file} and {row['file']} have by chance one id, {row['level_id']}: "
                "label one of them elsewhere, with out=NAME."
            )
