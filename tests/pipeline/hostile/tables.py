"""Mutations of parquet files: of their bytes, footers, pages, metadata and rows."""

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from random import Random
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from levelproof.configs.schema import hash_of
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY
from tests.pipeline.hostile.mutations import mutate_bytes, mutate_json, random_value

FIRST_ROWS = 3  # that mutations change


def mutate_parquet(bodies: Sequence[bytes], table: pa.Table, written: Mapping[str, Any], random: Random) -> bytes:
    """Change a parquet file: any byte, the footer, pages, metadata, or a value of the first rows.

    Args:
        bodies: valid files.
        table: one that `written`, arguments of pyarrow, make a valid file of.
        random: draws the mutation.
    """
    body = random.choice(bodies)
    match random.randrange(8):
        case 0 | 1:
            return mutate_bytes(body, random)
        case 2 | 3:  # the footer
            start = len(body) - 8 - int.from_bytes(body[-8:-4], "little")
            footer = mutate_bytes(body[start:-8], random)
            return body[:start] + footer + len(footer).to_bytes(4, "little") + b"PAR1"
        case 4:  # pages
            paged = bytearray(body)
            for _ in range(random.choice((1, 2, 10))):
                paged[random.randrange(4, len(paged) - 8)] = random.choice((0, 1, 127, 128, 255, random.randrange(256)))
            return bytes(paged)
        case 5 | 6:
            changed = _with_metadata(table, random)
        case _:
            changed = _with_value(table, random)
    sink = BytesIO()
    try:
        pq.write_table(changed, sink, **written | {"write_page_checksum": random.random() < 0.5})
    except pa.ArrowException:  # Arrow cannot write this table
        return mutate_bytes(body, random)
    return sink.getvalue()


def _with_metadata(table: pa.Table, random: Random) -> pa.Table:
    about = dict(table.schema.metadata)
    key = random.choice([key for key in about if not key.startswith(b"ARROW")])
    try:
        about[key] = mutate_json(json.loads(about[key]), random)[:2_000_000]
    except ValueError:
        about[key] = mutate_bytes(about[key], random)
    if key == CONFIG_KEY and random.random() < 0.5:
        about[HASH_KEY] = _hash_like(about[CONFIG_KEY])
    return table.replace_schema_metadata(about)


def _with_value(table: pa.Table, random: Random) -> pa.Table:
    i = random.randrange(table.num_columns)
    field = table.schema.field(i)
    values = table.column(i).to_pylist()
    row = random.randrange(FIRST_ROWS)
    known = values[row]
    if random.random() < 0.5:  # a value that occurs, or bytes that nearly do
        values[row] = mutate_bytes(known, random) if isinstance(known, bytes) else random.choice(values)
    else:
        values[row] = random_value(random)
    try:
        column = pa.array(values, field.type)
    except Exception:
        column = pa.array([None if at < FIRST_ROWS else value for at, value in enumerate(values)], field.type)
    return table.set_column(i, field.with_nullable(field.nullable or column.null_count > 0), column)


def _hash_like(config: bytes) -> bytes:
    try:
        return hash_of(json.loads(config)).encode()
    except (ValueError, RecursionError):
        return b"?"
