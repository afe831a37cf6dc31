"""What attempts that died have left in a split, and what of it may go; and what was merged into sealed fragments."""

import shutil
from collections.abc import Callable, Iterable
from os import DirEntry
from pathlib import Path

from pipeline.store.disk import flush_entry
from pipeline.store.layout import BEGUN, DATA, EXPERTS, JOB_BEGUN, MANIFEST, SHARDS, begun_path, data_path, entries
from pipeline.store.locks import nobody_commits
from pipeline.store.manifest import DATA_COLUMNS, Manifest, named_by, read_fragment, read_manifest


def clean(split: Path, say: Callable[[str], None]) -> Manifest:
    """Remove data of attempts that began and were not committed, half-written files, and what a sealed fragment has
    taken the place of; nothing else goes.

    Done while nobody commits: a worker of a killed run may still be about to name its shard. Data that no fragment
    names without being left by a dead attempt stays and `say` is told: its fragment may be kept elsewhere.

    Raises:
        Failure: a fragment is damaged.
        LockRefused: the file system has no locks.
    """
    with nobody_commits(split, say):
        manifest = read_manifest(split, ["label", *DATA_COLUMNS], compact=True)
        named = manifest.shards | manifest.named["experts"]
        for fragment in manifest.superseded:
            _, table = read_fragment(fragment.path, DATA_COLUMNS)
            theirs = frozenset.union(*(named_by([table], name) for name in DATA_COLUMNS))
            disown(data_path(split, name) for name in theirs - named)
            fragment.path.unlink()
        made = [*entries(split, SHARDS, DATA, DirEntry.is_dir), *entries(split, EXPERTS, DATA, DirEntry.is_file)]
        unnamed = [path for path in made if path.relative_to(split).as_posix() not in named]
        begun = entries(split, MANIFEST, BEGUN, DirEntry.is_file)
        dead = [path for path in unnamed if begun_path(path) in begun]
        for path in dead:
            _remove(path)
        stuck = {begun_path(path) for path in dead if path.exists()}
        for path in begun.keys() - stuck:
            path.unlink(missing_ok=True)
        for path in entries(split, "", JOB_BEGUN, DirEntry.is_file):
            path.unlink()
    if kept := sorted(set(unnamed) - set(dead)):
        more = f" and {len(kept) - 1} more like it" if kept[1:] else ""
        say(f"No fragment names {kept[0]}{more}: delete what belongs to no fragment that you keep elsewhere.")
    return manifest


def disown(data: Iterable[Path]) -> None:
    """Note that shards or experts go with the fragments that name them: as of attempts that were never committed.

    Raises:
        OSError: the disk refuses.
    """
    marks = [begun_path(path) for path in data]
    for mark in marks:
        mark.touch()
    for folder in {mark.parent for mark in marks}:
        flush_entry(folder)


def drop(shard: Path) -> None:
    """Remove a shard that `disown` was told of. What cannot go now is left to `clean`."""
    _remove(shard)
    if not shard.exists():
        begun_path(shard).unlink(missing_ok=True)


def _remove(data: Path) -> None:
    """A shard or experts, as far as they go now: files that are open stay on NFS, and the next run tries again."""
    if data.is_dir():
        shutil.rmtree(data, ignore_errors=True)
    else:
        data.unlink(missing_ok=True)
