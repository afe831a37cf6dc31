"""Forged splits with valid checksums, and what `examine` says of them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from levelproof.experts.labels import Label
from levelproof.pipeline.store.checksums import digests_of
from levelproof.pipeline.store.formats import DIGESTS_KEY
from levelproof.pipeline.store.layout import DATA
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.made import rewrite

UNIT, UNITS = 8, 6  # of the split that is forged

Row = dict[str, Any]


def forge(split: Path, change: Callable[[Row], None] = lambda row: None, level_ids: list[int] | None = None) -> None:
    """Change rows, and rewrite their fragments with valid checksums."""
    for path in fragment_paths(split):
        table = pq.read_table(path)
        rows = table.to_pylist()
        for row in rows:
            if level_ids is None or row["level_id"] in level_ids:
                change(row)
        named = {row["shard"] for row in rows if row["shard"] and DATA.fullmatch(row["shard"])}
        names = {name for name in named if (split / name).exists()}
        digests = {DIGESTS_KEY: json.dumps({name: digests_of(split / name) for name in names})}
        rewrite(path, pa.Table.from_pylist(rows, schema=table.schema), digests, write_page_checksum=True)


def rows_labelled(split: Path, *labels: Label) -> list[Row]:
    return [row for row in read_manifest(split).table.to_pylist() if row["label"] in labels]


def assert_reported(split: Path, *sentences: str) -> None:
    wrong = examine(split).sentences
    assert len(wrong) == len(sentences), wrong
    for sentence, reported in zip(sentences, sorted(wrong), strict=True):
        assert sentence in reported
