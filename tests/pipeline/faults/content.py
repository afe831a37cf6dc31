"""Reproducible content of a folder of splits: equal for any two runs of a job."""

import hashlib
import re
from contextlib import suppress
from pathlib import Path

from levelproof.pipeline.store.checksums import digests_of
from levelproof.pipeline.store.columns import OF_THE_RUN
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import ATTEMPT, COMMIT_LOCK, EVENTS, WRITER_LOCK
from levelproof.pipeline.store.manifest import read_manifest

Tree = dict[str, list[str]]  # digests of the files at each path; paths omit the names of attempts
Rows = dict[int, str]  # reproducible part of each level's row


def content_of(folder: Path) -> Tree:
    """Return digests of all files below a folder, of fragments only rows and metadata; locks and events are omitted."""
    tree: Tree = {}
    for path in sorted(folder.rglob("*")):
        if path.is_dir() or path.name in (WRITER_LOCK, COMMIT_LOCK) or path.parent.name == EVENTS:
            continue
        data = _fragment(path) if path.suffix == ".parquet" else path.read_bytes()
        name = _without_attempts(path.relative_to(folder).as_posix())
        tree[name] = sorted([*tree.get(name, []), hashlib.sha256(data).hexdigest()])
    return tree


def _without_attempts(text: str) -> str:
    """Remove the random names that distinguish attempts at a unit."""
    return re.sub(ATTEMPT, r"\1-\2", text)


def _fragment(path: Path) -> bytes:
    fragment, table = read_fragment(path)
    rows = [row | {"seconds": None} for row in table.to_pylist()]
    facts = fragment.config_hash, fragment.sealed, sorted(fragment.densities), fragment.digests, rows
    return _without_attempts(repr(facts)).encode()


def rows_of(folder: Path) -> dict[str, Rows]:
    """Return the rows of each split below a folder."""
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
    """Check that readers see only rows of the undisturbed run, and that the data of these rows is undamaged."""
    for name, rows in rows_of(folder).items():
        assert rows.items() <= whole[name].items(), "a row differs"
    for split in _splits(folder):
        manifest = read_manifest(split)
        named = manifest.shards | manifest.named["experts"]
        for fragment in manifest.counting:
            for name in fragment.digests.keys() & named:
                digests = {}
                with suppress(FileNotFoundError):  # sealing deletes it concurrently
                    digests = digests_of(split / name)
                if digests != fragment.digests[name]:  # unless it was sealed since the manifest was read
                    assert name not in read_manifest(split, ["shard", "experts"]).shards, f"{name} is damaged"


def differences(content: Tree, wanted: Tree) -> str:
    """Describe the differences in sentences."""
    extra, missing = sorted(content.keys() - wanted.keys()), sorted(wanted.keys() - content.keys())
    changed = sorted(name for name in content.keys() & wanted.keys() if content[name] != wanted[name])
    return f"extra: {extra}; missing: {missing}; changed: {changed}"
