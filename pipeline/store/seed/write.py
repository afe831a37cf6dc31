"""Writing of seed files, row group after row group."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from levelproof.configs.schema import hash_of
from levelproof.pipeline.store.checksums import with_own
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY
from levelproof.pipeline.store.seed.columns import (
    BUDGET_KEY,
    CONTENT_KEY,
    ROW_GROUP,
    SCHEMA,
    SEED_KEY,
    SEED_VERSION,
    WRITTEN,
)


def seed_bytes(groups: Iterable[tuple[pa.Table, Sequence[str]]], config: Mapping[str, Any], budget: str) -> bytes:
    """Return the bytes of a seed file.

    Args:
        groups: for each row group, all of ROW_GROUP rows except the last, its columns and its levels' content hashes.
        config: settings that decide the results.
        budget: as typed.
    """
    whole, content = pa.BufferOutputStream(), []
    with pq.ParquetWriter(whole, SCHEMA, **WRITTEN) as writer:
        for table, hashes in groups:
            writer.write_table(table.cast(SCHEMA), row_group_size=ROW_GROUP)
            content.append(content_digest(hashes))
        writer.add_key_value_metadata(
            {
                SEED_KEY: SEED_VERSION,
                HASH_KEY: hash_of(dict(config)),
                CONFIG_KEY: json.dumps(config, sort_keys=True),
                BUDGET_KEY: budget,
                CONTENT_KEY: json.dumps(content),
            }
        )
    return with_own(whole.getvalue().to_pybytes())


def content_digest(hashes: Iterable[str]) -> str:
    """Return the SHA-256 of content hashes, each followed by a newline."""
    return hashlib.sha256("".join(f"{one}\n" for one in hashes).encode()).hexdigest()
