"""Reading one fragment, which is untrusted: bytes, metadata and rows are checked before use."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa

from levelproof.configs.schema import KEYS_EVERY, Density, hash_of, stored_as
from levelproof.experts.labels import Label, Source
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.bounds import DAMAGE, DataUnread, bounded, unread
from levelproof.pipeline.store.columns import COLUMNS, MANIFEST_VERSION
from levelproof.pipeline.store.formats import CONFIG_KEY, DENSITIES_KEY, DIGESTS_KEY, HASH_KEY, SEALED_KEY, VERSION_KEY
from levelproof.pipeline.store.layout import ids_of
from levelproof.pipeline.store.remote import FileChanged, mended
from levelproof.pipeline.urls import quoted

FULL = (stored_as("full"),)
DENSITIES = {stored_as(density, every) for density in get_args(Density) for every in KEYS_EVERY}
MAX_BRACKETS = 500  # in a fragment's settings: Python's JSON parser fails at a nesting depth of 1,000
KNOWN = {"label": {*Label}, "witness": {*Source, None}, "size": set()}  # valid values; sizes are parsed instead


@dataclass(frozen=True)
class Fragment:
    """Metadata of one fragment, without its rows."""

    path: Path
    config_hash: str  # hash of `config`
    config: dict[str, Any]  # the settings that decide results
    digests: dict[str, dict[str, str]]  # of the files of each shard and checkpoint that its rows name
    rows: int
    sealed: bool
    densities: frozenset[str]  # requested for its shards (`configs.schema.stored_as`)


def read_fragment(
    path: Path, columns: Sequence[str] | None = None, level_ids: np.ndarray | None = None, compact: bool = False
) -> tuple[Fragment, pa.Table]:
    """Read a fragment and its rows; with `level_ids` (ascending), at least the rows of these levels.

    `compact`: return repetitive columns as dictionaries.

    Raises:
        FileNotFoundError: it is missing.
        DataUnread: this machine cannot read it, or it has another version.
        Failure: it is damaged.
    """
    try:
        with bounded(path) as file:
            metadata = file.metadata
            version = metadata.get(VERSION_KEY, b"?").decode()
            if not version.isdecimal():
                raise ValueError("it has no version")
            if version != str(MANIFEST_VERSION):
                raise DataUnread(
                    f"The fragment {path} has manifest version {version[:9]}, but this program reads version "
                    f"{MANIFEST_VERSION}: use the levelproof that wrote it."
                )
            config_hash = metadata[HASH_KEY].decode()
            config = settings_in(metadata[CONFIG_KEY], config_hash)
            digests, densities = _digests_in(metadata), _densities_in(metadata)
            fragment = Fragment(path, config_hash, config, digests, file.rows, SEALED_KEY in metadata, densities)
            table = file.read(COLUMNS.names if columns is None else columns, level_ids, compact)
            if "level_id" in table.column_names:
                _require_own_levels(table.column("level_id").to_numpy(), path)
            _require_known(table)
    except FileNotFoundError:
        raise
    except FileChanged as error:  # the listed version is gone: readers of a manifest list its fragments again
        raise FileNotFoundError(str(path)) from error
    except PermissionError:
        raise DataUnread(f"The fragment {path} cannot be read: check its permissions.") from None
    except DAMAGE as error:
        raise unread(path, error) or Failure(
            f"The fragment {path} is damaged ({type(error).__name__}): "
            + mended(path, f"run `levelproof verify {quoted(path.parent.parent)} --repair` to regenerate its levels.")
        ) from error
    return fragment, table


def _require_own_levels(level_ids: np.ndarray, path: Path) -> None:
    """Raise ValueError if level ids lie outside of the range in the fragment's name."""
    first, last = ids_of(path)
    if len(level_ids) and not first <= level_ids.min() <= level_ids.max() <= min(last, MAX_LEVEL_ID):
        raise ValueError("its levels are not in the range that its name says")


def _require_known(table: pa.Table) -> None:
    """Raise ValueError if rows have unknown labels, witnesses or sizes."""
    values = {name: table.column(name).unique().to_pylist() for name in table.column_names if name in KNOWN}
    if not all(set(column) <= KNOWN[name] for name, column in values.items() if KNOWN[name]):
        raise ValueError("it has unknown labels or witnesses")
    for size in values.get("size", ()):
        size_of(size)


def _densities_in(metadata: Mapping[bytes, bytes]) -> frozenset[str]:
    densities = frozenset(json.loads(metadata[DENSITIES_KEY]))
    if not densities <= DENSITIES:
        raise ValueError("it names an unknown density")
    return densities


def _digests_in(metadata: Mapping[bytes, bytes]) -> dict[str, dict[str, str]]:
    digests = json.loads(metadata[DIGESTS_KEY])
    if not isinstance(digests, dict) or not all(isinstance(files, dict) for files in digests.values()):
        raise ValueError("its digests are invalid")
    return digests


@lru_cache(maxsize=8)
def settings_in(text: bytes, config_hash: str) -> dict[str, Any]:
    """Parse a fragment's settings. Most fragments repeat the last one.

    Raises:
        ValueError: they are invalid, or do not match the hash.
    """
    config = json.loads(text)
    if not isinstance(config, dict) or text.count(b"[") + text.count(b"{") > MAX_BRACKETS:
        raise ValueError("its settings are invalid")
    if hash_of(config) != config_hash:
        raise ValueError("its settings do not match their hash")
    return config
