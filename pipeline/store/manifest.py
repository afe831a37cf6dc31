"""The manifest: one parquet fragment per work unit, each the commit marker of its unit.

A fragment is written last and appears at once or not at all; readers see only what fragments name.
"""

import json
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from os import DirEntry
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from configs.convert import flat
from configs.schema import hash_of
from pipeline.errors import Failure, UserError
from pipeline.store.checksums import digest_of, with_own
from pipeline.store.disk import flush, flush_entry
from pipeline.store.layout import FRAGMENT, MANIFEST, Attempt, entries, ids_of
from pipeline.store.schema import COLUMNS, CONFIG_KEY, DIGESTS_KEY, HASH_KEY, MANIFEST_VERSION, VERSION_KEY

SHOWN = 6  # differing settings that an error lists
THREADS = 8  # fragments read at once: a shared folder takes its time for each
DATA_COLUMNS = ("shard", "experts")  # name what lies beside the manifest


@dataclass(frozen=True)
class Fragment:
    """What one fragment says, without its rows."""

    path: Path
    config_hash: str
    config: dict[str, Any]  # the settings that decide results
    digests: dict[str, str]  # of the shards and checkpoints that its rows name


def begin_fragment(attempt: Attempt) -> None:
    """Note on the disk that an attempt begins to write: what it leaves when it dies can be told from what others own.

    Raises:
        OSError: the disk refuses.
    """
    attempt.begun.parent.mkdir(parents=True, exist_ok=True)
    attempt.begun.touch(exist_ok=False)
    flush(attempt.begun)


def write_fragment(
    attempt: Attempt, rows: Sequence[Mapping[str, Any]], config_hash: str, config: Mapping[str, Any]
) -> None:
    """Commit a unit: write its manifest rows to the attempt's fragment, durably and in one step.

    Raises:
        OSError: the disk refuses; no fragment is there then, or the one that was there before.
    """
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=COLUMNS)
    metadata = {
        VERSION_KEY: str(MANIFEST_VERSION).encode(),
        HASH_KEY: config_hash.encode(),
        CONFIG_KEY: json.dumps(config, sort_keys=True).encode(),
        DIGESTS_KEY: json.dumps(_digests(attempt.fragment.parent.parent, table)).encode(),
    }
    table = table.replace_schema_metadata(metadata)
    whole = pa.BufferOutputStream()
    pq.write_table(table, whole, compression="zstd", write_page_checksum=True)
    attempt.begun.write_bytes(with_own(whole.getvalue().to_pybytes()))
    flush_entry(attempt.begun)
    attempt.begun.replace(attempt.fragment)
    flush_entry(attempt.fragment.parent)  # the new name itself


def _digests(split: Path, table: pa.Table) -> dict[str, str]:
    """Of the shards and checkpoints that these rows name, as they are on the disk now."""
    names = sorted(name for column in DATA_COLUMNS for name in table.column(column).unique().to_pylist() if name)
    return {name: digest_of(split / name) for name in names if (split / name).exists()}


def fragment_paths(split: Path) -> list[Path]:
    """All committed fragments of a split, in the order of their level ids: files with the exact name of one.

    Whatever else is in the folder (copies, links, what file systems and editors leave) is none.
    """
    return sorted(entries(split, MANIFEST, FRAGMENT, DirEntry.is_file))


def read_fragment(path: Path, columns: Sequence[str] | None = None) -> tuple[Fragment, pa.Table]:
    """A fragment and its rows.

    Raises:
        Failure: it is damaged, or of another version.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            metadata = file.schema_arrow.metadata or {}
            version = metadata.get(VERSION_KEY, b"?").decode()
            if version != str(MANIFEST_VERSION):
                raise Failure(
                    f"The fragment {path} has manifest version {version}, this program reads {MANIFEST_VERSION}: "
                    "use the levelproof that wrote it."
                )
            config, true_hash = _config_in(metadata[CONFIG_KEY])
            digests = json.loads(metadata.get(DIGESTS_KEY, b"{}"))
            fragment = Fragment(path, metadata[HASH_KEY].decode(), config, digests)
            if not file.schema_arrow.equals(COLUMNS) or true_hash != fragment.config_hash:
                raise ValueError("its footer has other columns or another configuration than were written")
            table = file.read(columns=None if columns is None else list(columns), use_threads=False)
    except PermissionError:
        raise Failure(f"The fragment {path} cannot be read: check its permissions.") from None
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        raise Failure(
            f"The fragment {path} is damaged ({type(error).__name__}): "
            "delete it and run the same `levelproof generate` again to remake its levels."
        ) from error
    return fragment, table


@lru_cache(maxsize=8)
def _config_in(text: bytes) -> tuple[dict[str, Any], str]:
    """A configuration and its hash: nearly always those of the fragment before."""
    config = json.loads(text)
    return config, hash_of(config)


@dataclass(frozen=True)
class Manifest:
    """Committed rows of a split, sorted by level id; each level once."""

    split: Path
    fragments: tuple[Fragment, ...]  # that were read
    table: pa.Table
    named: Mapping[str, frozenset[str]]  # by column (shard, experts), if it was read: what any fragment names

    @property
    def level_ids(self) -> np.ndarray:
        return self.table.column("level_id").to_numpy()

    @property
    def labels(self) -> np.ndarray:
        labels = self.table.column("label").combine_chunks().dictionary_encode()
        return np.array(labels.dictionary.to_pylist(), dtype=str)[labels.indices.to_numpy()]

    @property
    def shards(self) -> frozenset[str]:
        """Paths below the split. KeyError where the column was not read."""
        return self.named["shard"]

    @property
    def config(self) -> dict[str, Any] | None:
        """The settings that made it; None while it is empty."""
        return self.fragments[0].config if self.fragments else None

    @property
    def config_hash(self) -> str | None:
        return self.fragments[0].config_hash if self.fragments else None


def read_manifest(
    split: Path, columns: Sequence[str] | None = None, level_ids: Sequence[int] | None = None
) -> Manifest:
    """The manifest of a split, one row for each level that was tried; empty where nothing is committed yet.

    Args:
        split: the folder `{out}/{budget}/{size}`.
        columns: which to read (default: all); `level_id` is always among them.
        level_ids: whose rows (default: all); fragments without any of them, by their names, are not opened.

    Raises:
        Failure: a fragment is damaged, or fragments of several configurations lie side by side.
    """
    names = COLUMNS.names if columns is None else list(dict.fromkeys(["level_id", *columns]))
    paths = fragment_paths(split)
    if level_ids is not None:
        wanted = np.unique(np.asarray(level_ids, np.int64)).tolist()
        paths = [path for path in paths if bisect_left(wanted, ids_of(path)[0]) < bisect_right(wanted, ids_of(path)[1])]
    with ThreadPoolExecutor(THREADS) as threads:
        read = list(threads.map(lambda path: read_fragment(path, names), paths))
    fragments = tuple(fragment for fragment, _ in read)
    for fragment in fragments[1:]:
        if fragment.config_hash != fragments[0].config_hash:
            changes = told(differences(fragments[0].config, fragment.config))
            raise Failure(
                f"The split {split} mixes two configurations, {fragments[0].path.name} and {fragment.path.name} "
                f"({changes}): move the fragments of one of them elsewhere, with the shards and experts that are "
                "named after them."
            )
    schema = pa.schema([COLUMNS.field(name) for name in names])
    table = pa.concat_tables([schema.empty_table(), *(part.select(names).cast(schema) for _, part in read)])
    data = [name for name in DATA_COLUMNS if name in names]
    named = {name: frozenset(path for path in table.column(name).unique().to_pylist() if path) for name in data}
    if level_ids is not None:
        table = table.filter(np.isin(table.column("level_id").to_numpy(), np.asarray(level_ids, np.int64)))
    _, first = np.unique(table.column("level_id").to_numpy(), return_index=True)  # sorts; a level counts once
    return Manifest(split, fragments, table.take(first), named)


def require_manifest(
    split: Path, columns: Sequence[str] | None = None, level_ids: Sequence[int] | None = None
) -> Manifest:
    """As `read_manifest`, for questions about a split that should be there; it may have none of the levels.

    Raises:
        UserError: there is no split here, or nothing is committed in it.
        Failure: as `read_manifest`.
    """
    manifest = read_manifest(split, columns, level_ids)
    if not manifest.fragments and (level_ids is None or not fragment_paths(split)):
        what = f"Nothing is committed in {split} yet" if split.is_dir() else f"There is no split at {split}"
        raise UserError(f"{what}: give a folder such as data/128k/s that `levelproof generate` made.")
    return manifest


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that differ, by their dotted names; `absent` where one side does not have it."""
    a, b = flat(old), flat(new)
    names = sorted(name for name in a.keys() | b.keys() if a.get(name, "absent") != b.get(name, "absent"))
    return {name: (a.get(name, "absent"), b.get(name, "absent")) for name in names}


def told(changes: Mapping[str, tuple[Any, Any]]) -> str:
    """`differences` in words, the first SHOWN of them."""
    shown = [f"{name} was {old}, now {new}" for name, (old, new) in list(changes.items())[:SHOWN]]
    return "; ".join(shown) + (f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else "")
