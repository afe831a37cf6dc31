"""Columns of a seed file, and the keys of its metadata. docs/seeds.md is their documentation.

Columns that follow from others or from the configuration are left out; `pipeline.store.seed.rows` recomputes them.
"""

from typing import Any

import pyarrow as pa

from levelproof.pipeline.store.bounds import FileKind

SEED_VERSION = "2"
SEED_KEY = b"levelproof.seed_version"
BUDGET_KEY = b"levelproof.budget"  # as typed
CONTENT_KEY = b"levelproof.content_sha256"  # of the content hashes of each row group, as a JSON list

FIELDS = (
    pa.field("level_id", pa.int32(), nullable=False),
    pa.field("witness", pa.binary()),  # `packed.pack_witness`; null: no witness
    pa.field("content", pa.binary()),  # `worlds.pack_worlds`; null: sampled from the id
    pa.field("checksum", pa.uint32()),  # `experts.witness.episode.checksum_of`; null: no witness
    pa.field("label", pa.string(), nullable=False),
    pa.field("label_reason", pa.string()),  # null: that of `rows.reason_of`
    pa.field("source", pa.string()),  # the manifest's `witness`
    pa.field("steps_to_goal", pa.int32()),
    pa.field("success_rate", pa.float32()),
    pa.field("most_probable_succeeds", pa.bool_(), nullable=False),
    pa.field("sticky_success_rate", pa.float32()),
    pa.field("perturbed_success_rate", pa.float32()),
    pa.field("portability", pa.float32()),
    pa.field("failed_by_noop", pa.bool_(), nullable=False),
    pa.field("file", pa.string()),
    pa.field("made_with", pa.string(), nullable=False),  # the manifest's `versions`, `engine` and `device`, as JSON
)
SCHEMA = pa.schema(FIELDS)
# Same name and meaning as in the manifest
KEPT = (
    "label", "steps_to_goal", "success_rate", "most_probable_succeeds", "sticky_success_rate", "perturbed_success_rate",
    "portability", "failed_by_noop", "file",
)  # fmt: skip
ROW_GROUP = 2**16  # rows that are read or skipped together
BYTES = ("witness", "content")
DELTA_LENGTHS = 6  # parquet's number of the encoding of BYTES
SEEDS = FileKind(
    "seed file",
    SCHEMA,
    ("label", "label_reason", "source", "file", "made_with"),
    BYTES,
    DELTA_LENGTHS,
    max_rows=2**24,
    min_row_bytes=1,
    max_row=2**9,
    max_of={"content": 2**16},
)
WRITTEN: dict[str, Any] = {  # how pyarrow writes one
    "compression": "zstd",
    "compression_level": 19,
    "use_dictionary": [
        "label", "label_reason", "source", "steps_to_goal", "success_rate", "sticky_success_rate",
        "perturbed_success_rate", "portability", "file", "made_with",
    ],
    "column_encoding": {"level_id": "DELTA_BINARY_PACKED", **dict.fromkeys(BYTES, "DELTA_LENGTH_BYTE_ARRAY")},
    "write_page_checksum": True,
}  # fmt: skip
