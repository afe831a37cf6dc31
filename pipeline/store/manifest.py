"""The manifest: one parquet fragment per work unit, each the commit marker of its unit.

A fragment is written last and appears at once or not at all; readers see only what fragments name.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from configs.convert import flat
from configs.schema import hash_of
from pipeline.errors import Failure, UserError
from pipeline.store.layout import MANIFEST
from pipeline.store.schema import COLUMNS, CONFIG_KEY, HASH_KEY, MANIFEST_VERSION, VERSION_KEY

SHOWN = 6  # differing settings that an error lists


@dataclass(frozen=True)
class Fragment:
    """What one fragment says, without its rows."""

    path: Path
    config_hash: str
    config: dict[str, Any]  # the settings that decide results


def write_fragment(path: Path, rows: Sequence[Mapping[str, Any]], config_hash: str, config: Mapping[str, Any]) -> None:
    """Commit a unit: write its manifest rows to `path`, durably and in one step.

    Raises:
        OSError: the disk refuses; nothing is at `path` then, or what was there before.
    """
    metadata = {
        VERSION_KEY: str(MANIFEST_VERSION).encode(),
        HASH_KEY: config_hash.encode(),
        CONFIG_KEY: json.dumps(config, sort_keys=True).encode(),
    }
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=COLUMNS.with_metadata(metadata))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            pq.write_table(table, file, compression="zstd", write_page_checksum=True)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name itself
    finally:
        os.close(folder)


def fragment_paths(split: Path) -> list[Path]:
    """All committed fragments of a split, in the order of their level ids."""
    return sorted(path for path in (split / MANIFEST).glob("*.parquet") if not path.name.startswith("."))


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
            fragment = Fragment(path, metadata[HASH_KEY].decode(), json.loads(metadata[CONFIG_KEY]))
            if not file.schema_arrow.equals(COLUMNS) or hash_of(fragment.config) != fragment.config_hash:
                raise ValueError("its footer has other columns or another configuration than were written")
            table = file.read(columns=None if columns is None else list(columns))
    except PermissionError:
        raise Failure(f"The fragment {path} cannot be read: check its permissions.") from None
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        raise Failure(
            f"The fragment {path} is damaged ({type(error).__name__}): "
            "delete it and run the same `levelproof generate` again to remake its levels."
        ) from error
    return fragment, table


@dataclass(frozen=True)
class Manifest:
    """All committed rows of a split, sorted by level id; each level once."""

    split: Path
    fragments: tuple[Fragment, ...]
    table: pa.Table
    shards: frozenset[str]  # that any fragment names; paths below the split
    experts: frozenset[str]  # likewise

    @property
    def level_ids(self) -> np.ndarray:
        return self.table.column("level_id").to_numpy()

    @property
    def labels(self) -> np.ndarray:
        return np.asarray(self.table.column("label").to_pylist(), dtype=str)

    @property
    def config(self) -> dict[str, Any] | None:
        """The settings that made it; None while it is empty."""
        return self.fragments[0].config if self.fragments else None

    @property
    def config_hash(self) -> str | None:
        return self.fragments[0].config_hash if self.fragments else None


def read_manifest(split: Path, columns: Sequence[str] | None = None) -> Manifest:
    """The manifest of a split, one row for each level that was tried; empty where nothing is committed yet.

    Args:
        split: the folder `{out}/{budget}/{size}`.
        columns: which to read (default: all); `level_id`, `shard` and `experts` are always among them.

    Raises:
        Failure: a fragment is damaged, or fragments of several configurations lie side by side.
    """
    names = None if columns is None else list(dict.fromkeys(["level_id", "shard", "experts", *columns]))
    read = [read_fragment(path, names) for path in fragment_paths(split)]
    fragments = tuple(fragment for fragment, _ in read)
    for fragment in fragments[1:]:
        if fragment.config_hash != fragments[0].config_hash:
            changes = told(differences(fragments[0].config, fragment.config))
            raise Failure(
                f"The split {split} mixes two configurations, {fragments[0].path.name} and {fragment.path.name} "
                f"({changes}): move the fragments of one of them elsewhere."
            )
    schema = COLUMNS if names is None else pa.schema([COLUMNS.field(name) for name in names])
    table = (
        pa.concat_tables([part for _, part in read]).select(schema.names).cast(schema) if read else schema.empty_table()
    )
    _, first = np.unique(table.column("level_id").to_numpy(), return_index=True)  # sorts; a level counts once
    shards, experts = (
        frozenset(name for name in table.column(of).unique().to_pylist() if name) for of in ("shard", "experts")
    )
    return Manifest(split, fragments, table.take(first).replace_schema_metadata(None), shards, experts)


def require_manifest(split: Path, columns: Sequence[str] | None = None) -> Manifest:
    """As `read_manifest`, for questions about a split that should be there.

    Raises:
        UserError: there is no split here, or nothing is committed in it.
        Failure: as `read_manifest`.
    """
    if not split.is_dir():
        raise UserError(
            f"There is no split at {split}: give a folder such as data/128k/s that `levelproof generate` made."
        )
    manifest = read_manifest(split, columns)
    if not manifest.fragments:
        raise UserError(
            f"Nothing is committed in {split} yet: give a folder such as data/128k/s that `levelproof generate` made."
        )
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
