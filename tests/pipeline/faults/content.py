"""What is in a folder of splits, but for what tells of a run: two runs of a job have the same."""

import hashlib
import re
from contextlib import suppress
from pathlib import Path

from levelproof.pipeline.store.checksums import digests_of
from levelproof.pipeline.store.columns import OF_THE_RUN
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import ATTEMPT, COMMIT_LOCK, EVENTS, WRITER_LOCK
from levelproof.pipeline.store.manifest import read_manifest

Tree = dict[str, list[str]]  # of files: their paths, without what tells attempts apart, and what is in each
Rows = dict[int, str]  # what lasts of a level's row


def content_of(folder: Path) -> Tree:
    """Every file below a folder, byte by byte; of fragments rows and metadata. Locks and events are left out."""
    tree: Tree = {}
    for path in sorted(folder.rglob("*")):
        if path.is_dir() or path.name in (WRITER_LOCK, COMMIT_LOCK) or path.parent.name == EVENTS:
            continue
        what = _fragment(path) if path.suffix == ".parquet" else path.read_bytes()
        name = _plain(path.relative_to(folder).as_posix())
        tree[name] = sorted([*tree.get(name, []), hashlib.sha256(what).hexdigest()])
    return tree


def _plain(text: str) -> str:
    """Without what tells attempts at a unit apart."""
    return re.sub(ATTEMPT, r"\1-\2", text)


def _fragment(path: Path) -> bytes:
    fragment, table = read_fragment(path)
    rows = [row | {"seconds": None} for row in table.to_pylist()]
    about = fragment.config_hash, fragment.sealed, sorted(fragment.densities), fragment.digests, rows
    return _plain(repr(about)).encode()


def rows_of(folder: Path) -> dict[str, Rows]:
    """The rows of each split below a folder."""
    return {
        split.relative_to(folder).as_posix(): {
            row["level_id"]: repr({name: x for name, x in row.items() if name not in OF_THE_RUN})
            for row in read_manifest(split).table.to_pylist()
        }
        for split in _splits(folder)
    }


def _splits(folder: Path) -> set[Path]:
    return {path.parent for path in folder.glob("*/*/manifest")}


def require_sound(folder: Path, whole: dict[str, Rows]) -> None:
    """What readers see is of the whole, with every byte that was committed of its data."""
    for name, rows in rows_of(folder).items():
        assert rows.items() <= whole[name].items(), "a row is another"
    for split in _splits(folder):
        manifest = read_manifest(split)
        named = manifest.shards | manifest.named["experts"]
        for fragment in manifest.counting:
            for name in fragment.digests.keys() & named:
                there = {}
                with suppress(FileNotFoundError):  # it goes meanwhile
                    there = digests_of(split / name)
                if there != fragment.digests[name]:  # or it was sealed a moment ago
                    assert name not in read_manifest(split, ["shard", "experts"]).shards, f"{name} is damaged"


def differences(there: Tree, wanted: Tree) -> str:
    """For people."""
    more, less = sorted(there.keys() - wanted.keys()), sorted(wanted.keys() - there.keys())
    other = sorted(name for name in there.keys() & wanted.keys() if there[name] != wanted[name])
    return f"more: {more}; missing: {less}; other: {other}"
