"""What attempts that died have left in a split, and what of it may go."""

import shutil
from collections.abc import Callable
from os import DirEntry
from pathlib import Path

from pipeline.store.layout import BEGUN, DATA, EXPERTS, JOB_BEGUN, MANIFEST, SHARDS, attempt_of, entries
from pipeline.store.locks import nobody_commits
from pipeline.store.manifest import DATA_COLUMNS, Manifest, read_manifest


def clean(split: Path, say: Callable[[str], None]) -> Manifest:
    """Remove data of attempts that began and were not committed, and half-written files; nothing else goes.

    Done while nobody commits: a worker of a killed run may still be about to name its shard. Data that no fragment
    names without being left by a dead attempt stays and `say` is told: its fragment may be kept elsewhere.

    Raises:
        Failure: a fragment is damaged.
        LockRefused: the file system has no locks.
    """
    with nobody_commits(split, say):
        manifest = read_manifest(split, ["label", *DATA_COLUMNS])
        named = manifest.shards | manifest.named["experts"]
        made = [*entries(split, SHARDS, DATA, DirEntry.is_dir), *entries(split, EXPERTS, DATA, DirEntry.is_file)]
        unnamed = [path for path in made if path.relative_to(split).as_posix() not in named]
        begun = {attempt_of(path): path for path in entries(split, MANIFEST, BEGUN, DirEntry.is_file)}
        dead = [path for path in unnamed if attempt_of(path) in begun]
        for path in dead:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        stuck = {attempt_of(path) for path in dead if path.exists()}  # open files, on NFS: the next run tries again
        for path in (path for attempt, path in begun.items() if attempt not in stuck):
            path.unlink()
        for path in entries(split, "", JOB_BEGUN, DirEntry.is_file):
            path.unlink()
    if kept := sorted(set(unnamed) - set(dead)):
        more = f" and {len(kept) - 1} more like it" if kept[1:] else ""
        say(f"No fragment names {kept[0]}{more}: delete what belongs to no fragment that you keep elsewhere.")
    return manifest
