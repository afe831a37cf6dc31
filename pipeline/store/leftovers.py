"""Removal of what dead attempts left in a split, and of what sealed fragments supersede."""

import os
from collections.abc import Callable, Iterable
from itertools import chain
from os import DirEntry
from pathlib import Path

from levelproof.pipeline.store.disk import flush_entry, regular
from levelproof.pipeline.store.files import remove, remove_data
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import (
    BEGUN,
    INDEX_BEGUN,
    JOB_BEGUN,
    MANIFEST,
    NOTE_BEGUN,
    QUARANTINE,
    begun_path,
    data_path,
    data_paths,
    entries,
)
from levelproof.pipeline.store.locks import without_commits
from levelproof.pipeline.store.manifest import DATA_COLUMNS, Manifest, data_named_by, read_manifest
from levelproof.pipeline.store.objects import put
from levelproof.pipeline.store.publish import OVER, ended
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.urls import as_typed, is_remote


def clean(split: Path, say: Callable[[str], None]) -> Manifest:
    """Remove data of uncommitted attempts, half-written files, and what a sealed fragment supersedes; nothing else.

    Excludes commits, because a worker of a killed run may be about to commit its shard. Unnamed data without an
    attempt's mark stays and is reported through `say`: its fragment may be kept elsewhere.

    Raises:
        Failure: a fragment is damaged.
        LockRefused: the file system has no locks.
    """
    with without_commits(split, say):
        # Before the manifest: in a store, an earlier writer's worker may commit in between, and remove its mark
        begun = entries(split, MANIFEST, BEGUN, DirEntry.is_file)
        manifest = read_manifest(split, ["label", *DATA_COLUMNS], compact=True)
        named = manifest.shards | manifest.named["experts"]
        superseded = [fragment.path for fragment in manifest.superseded]
        theirs = at_once(split, lambda path: data_named_by(read_fragment(path, DATA_COLUMNS)[1]), superseded)
        disown(data_path(split, name) for name in frozenset().union(*theirs) - named)
        remove(*superseded)
        unnamed = [path for path in data_paths(split) if path.relative_to(split).as_posix() not in named]
        over = begun.keys()
        if is_remote(split):
            over = ended(split, begun, named)
        dead = [path for path in unnamed if begun_path(path) in over]
        remove_data(*dead)
        stuck = {begun_path(path) for path in dead if path.exists()}
        kinds = ("", JOB_BEGUN), (MANIFEST, INDEX_BEGUN), (QUARANTINE, NOTE_BEGUN)
        half = (entries(split, *kind, DirEntry.is_file) for kind in kinds)
        remove(*(over - stuck), *chain(*half))
    if kept := sorted(path for path in set(unnamed) - set(dead) if begun_path(path) not in begun):
        more = f" and {len(kept) - 1} more like it" if kept[1:] else ""
        data = f"{as_typed(kept[0])}{more}"
        say(f"No fragment names {data}: delete this data, unless a fragment that you keep elsewhere names it.")
    return manifest


def disown(data: Iterable[Path]) -> None:
    """Mark shards or experts as uncommitted, so that they are removed once their fragments are.

    Raises:
        NotRegular: a link or the like has the name of a mark.
        OSError: the write fails.
    """
    marks = [begun_path(path) for path in data]
    if marks and is_remote(marks[0]):
        at_once(marks[0], lambda mark: put(mark, OVER), marks)
        return
    for mark in marks:
        os.close(regular(mark, os.O_WRONLY | os.O_CREAT))
    for folder in {mark.parent for mark in marks}:
        flush_entry(folder)


def drop(*shards: Path) -> None:
    """Remove shards that `disown` marked. `clean` removes later what cannot be removed now."""
    remove_data(*shards)
    remove(*(begun_path(shard) for shard in shards if not shard.exists()))
