"""What one fragment says, of which nothing is believed: bytes, metadata and rows are looked at before they are used."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from levelproof.configs.schema import KEYS_EVERY, Density, decisive, hash_of, stored_as
from levelproof.experts.labels import Label, Source
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.bounds import DAMAGE, bounded
from levelproof.pipeline.store.columns import COLUMNS, MANIFEST_VERSION, VERSIONS, completed
from levelproof.pipeline.store.layout import ids_of
from levelproof.pipeline.store.remote import mended
from levelproof.pipeline.store.schema import CONFIG_KEY, DENSITIES_KEY, DIGESTS_KEY, HASH_KEY, SEALED_KEY, VERSION_KEY

FULL = (stored_as("full"),)
DENSITIES = {stored_as(density, every) for density in get_args(Density) for every in KEYS_EVERY}
MAX_BRACKETS = 500  # of settings, in a fragment's metadata: Python gives up on 1,000 that lie in each other
KNOWN = {"label": {*Label}, "witness": {*Source, None}, "size": set()}  # what stands in a column; of sizes, many


@dataclass(frozen=True)
class Fragment:
    """What one fragment says, without its rows."""

    path: Path
    config_hash: str  # of `config`
    config: dict[str, Any]  # the settings that decide results, under today's names
    digests: dict[str, dict[str, str]]  # of the files of each shard and checkpoint that its rows name
    rows: int
    sealed: bool
    densities: frozenset[str]  # how its shards were to be stored (`configs.schema.stored_as`)


def read_fragment(
    path: Path, columns: Sequence[str] | None = None, level_ids: np.ndarray | None = None, compact: bool = False
) -> tuple[Fragment, pa.Table]:
    """A fragment and its rows; with `level_ids` (ascending), at least those of these levels.

    `compact`: columns that are repetitive come as dictionaries.

    Raises:
        FileNotFoundError: it is gone.
        Failure: it is damaged, or of another version.
    """
    try:
        with bounded(path) as file:
            metadata = file.metadata
            version = metadata.get(VERSION_KEY, b"?").decode()
            if not version.isdecimal():
                raise ValueError("it has no version")
            if version not in VERSIONS:
                raise Failure(
                    f"The fragment {path} has manifest version {version[:9]}, this program reads {MANIFEST_VERSION}: "
                    "use the levelproof that wrote it."
                )
            written = metadata[HASH_KEY].decode()
            config, config_hash = _config_in(metadata[CONFIG_KEY], written)
            digests, densities = _digests_in(metadata), _densities_in(metadata)
            fragment = Fragment(path, config_hash, config, digests, file.rows, SEALED_KEY in metadata, densities)
            wanted = COLUMNS.names if columns is None else columns
            found = file.read(
                [name for name in wanted if name in VERSIONS[version]], VERSIONS[version], level_ids, compact
            )
            table = _with_hash(completed(found, wanted), written, config_hash)
            if "level_id" in table.column_names:
                _require_own_levels(table.column("level_id").to_numpy(), path)
            _require_known(table)
    except FileNotFoundError:
        raise
    except PermissionError:
        raise Failure(f"The fragment {path} cannot be read: check its permissions.") from None
    except DAMAGE as error:
        raise Failure(
            f"The fragment {path} is damaged ({type(error).__name__}): "
            + mended(path, f"run `levelproof verify {path.parent.parent} --repair` to make its levels again.")
        ) from error
    return fragment, table


def _require_own_levels(level_ids: np.ndarray, path: Path) -> None:
    """Raises ValueError where there are others than a fragment's name says."""
    first, last = ids_of(path)
    if len(level_ids) and not first <= level_ids.min() <= level_ids.max() <= min(last, MAX_LEVEL_ID):
        raise ValueError("it has other levels than its name says")


def _require_known(table: pa.Table) -> None:
    """Raises ValueError where rows have labels, witnesses or sizes that are none."""
    of = {name: table.column(name).unique().to_pylist() for name in table.column_names if name in KNOWN}
    if not all(set(values) <= KNOWN[name] for name, values in of.items() if KNOWN[name]):
        raise ValueError("it has labels or witnesses that are none")
    for size in of.get("size", ()):
        size_of(size)


def _densities_in(metadata: Mapping[bytes, bytes]) -> frozenset[str]:
    found = frozenset(json.loads(metadata.get(DENSITIES_KEY, json.dumps(FULL))))
    if not found <= DENSITIES:
        raise ValueError("it says that shards are stored as none is")
    return found


def _digests_in(metadata: Mapping[bytes, bytes]) -> dict[str, dict[str, str]]:
    found = json.loads(metadata.get(DIGESTS_KEY, b"{}"))
    if not isinstance(found, dict) or not all(isinstance(files, dict) for files in found.values()):
        raise ValueError("its digests are none")
    return found


@lru_cache(maxsize=8)
def _config_in(text: bytes, written: str) -> tuple[dict[str, Any], str]:
    """A configuration as this version has it, and its hash: nearly always those of the fragment before.

    `written` is the hash beside it, by the version that wrote both.
    """
    config = json.loads(text)
    if not isinstance(config, dict) or text.count(b"[") + text.count(b"{") > MAX_BRACKETS:
        raise ValueError("its settings are none")
    if hash_of(config) != written:
        raise ValueError("its footer has another configuration than was written")
    config = decisive(config)
    return config, hash_of(config)


def _with_hash(table: pa.Table, written: str, config_hash: str) -> pa.Table:
    """Rows that name their configuration as this version does."""
    if written == config_hash or "config_hash" not in table.column_names:
        return table
    at = table.schema.get_field_index("config_hash")
    column = table.column(at).cast(pa.string())
    renewed = pc.if_else(pc.equal(column, written), config_hash, column)  # pyright: ignore[reportAttributeAccessIssue]
    return table.set_column(at, table.schema.field(at), renewed.cast(table.schema.field(at).type))
