"""Fuzzing target of seed files: their tables, levels and witnesses."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from random import Random
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.store import bounds
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seed.columns import WRITTEN
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.seed.shard import SeedShard
from tests.pipeline.hostile.mutations import put, remove
from tests.pipeline.hostile.tables import mutate_parquet
from tests.pipeline.made import honest_split

NAMES = ["label", "label_reason", "witness", "shard", "row", "versions", "engine", "command", "success_rate", "file"]


def seeds(folder: Path) -> Callable[[Random], None]:
    """Return a target that reads one mutated seed file: its rows, and, where the settings are as they were, records."""
    path = folder / "levels.parquet"
    export_seed(honest_split(folder / "split", 16, 1), None, path)
    data, table = path.read_bytes(), pq.read_table(path)
    # Also what was added to the metadata after the schema
    table = table.replace_schema_metadata(
        {key: value for key, value in pq.read_metadata(path).metadata.items() if not key.startswith(b"ARROW")}
    )
    in_groups = BytesIO()
    pq.write_table(table, in_groups, row_group_size=5, **WRITTEN)
    bodies, good = [data, in_groups.getvalue()], SeedShard(path)
    size = good.size
    fields = [field for field in table_for(size) if field.name in ("record/action", "record/goal")]

    def target(random: Random) -> None:
        remove(path)
        put(path, mutate_parquet(bodies, table, WRITTEN, random), random)
        checked = {**bounds.READ_OPTIONS, "page_checksum_verification": random.random() < 0.3}
        with patch.object(bounds, "READ_OPTIONS", checked):
            if not is_seed(path):
                return
            names = random.sample(NAMES, random.choice((1, 2, len(NAMES))))
            ids = np.array([1, 9]) if random.random() < 0.3 else None
            manifest = read_manifest(path, names, ids, compact=random.random() < 0.5)
            manifest.table.to_pylist()
            assert "label" not in names or set(manifest.table["label"].to_pylist()) <= {*Label}
            shard = SeedShard(path)
            rows = [row for row, steps in enumerate(shard.steps) if steps][:8]
            if not rows or (shard._source, shard.encoding.rules) != (good._source, good.encoding.rules):
                return
            made = shard.restore([(shard, rows)], fields, [range(len(rows))]).arrays
            action = made["record/action"]
            assert action.shape == (len(rows), RECORD_STEPS, len(CHOICES))
            assert ((action >= 0) & (action < np.array(CHOICES))).all()

    return target
