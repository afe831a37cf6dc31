"""Sample of a split for the Hugging Face hub's viewer: rows of the manifest with pictures."""

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pyarrow as pa

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import size_of
from levelproof.levelgen.pictures.raster import rasterise
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Scene
from levelproof.levelgen.pictures.words import Caption
from levelproof.pipeline.look.show import recorded_film
from levelproof.pipeline.look.spread import spread
from levelproof.pipeline.read.levels import levels_of, rules_of, with_known_costs
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.progress_bar import shown_blocks

PICTURES = ("start", "goal")  # the initial world; the moment the witness reaches the goal, or null
SHOWN = (  # manifest columns beside the pictures
    "level_id", "label", "label_reason", "witness", "steps_to_goal", "success_rate", "portability", "env_steps",
    "command",
)  # fmt: skip
PIXELS = 220  # width of a picture
BLOCK = 16  # rows whose records are in memory at a time
RECORD_FIELDS = ("done", "goal", "action")
# Image columns as the library `datasets` writes them and the hub's viewer reads them
IMAGE = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])
FEATURES = json.dumps({"info": {"features": {name: {"_type": "Image"} for name in PICTURES}}})
SCHEMA = pa.schema(
    [*(pa.field(name, IMAGE) for name in PICTURES), *(COLUMNS.field(name).with_nullable(True) for name in SHOWN)],
    metadata={"huggingface": FEATURES},
)


def preview(manifest: Manifest, count: int) -> pa.Table:
    """Select at most `count` rows, spread evenly over the manifest's level ids, with pictures.

    Raises:
        Failure: a shard is damaged, or a level file is missing.
    """
    ids = manifest.level_ids
    chosen = ids[spread(len(ids), count)]
    full = require_manifest(manifest.split, level_ids=chosen.tolist())
    full = replace(full, table=with_known_costs(full))
    blocks = shown_blocks(full.table.num_rows, BLOCK, f"pictures of {manifest.split}")
    rows = [row for first in blocks for row in _pictured(full, full.table.slice(first, BLOCK))]
    return pa.Table.from_pylist(rows, SCHEMA)


def _pictured(manifest: Manifest, rows: pa.Table) -> Iterator[dict[str, Any]]:
    solved, arrays = rows.column("shard").is_valid().to_numpy(), {}
    if solved.any():
        size = size_of(rows.column("size")[0].as_py())
        names = [field.name for field in table_for(size) if field.name.startswith(("level/", "record/state/"))]
        arrays = read_rows(manifest.split, rows.filter(solved), [*names, *(f"record/{name}" for name in RECORD_FIELDS)])
    level, rules, recorded = levels_of(manifest, rows), rules_of(manifest), 0
    for lane, row in enumerate(rows.to_pylist()):
        scenes = [scene_of(level, level.state, lane, caption=Caption(f"level {row['level_id']}"))]
        if solved[lane]:
            one = {name: values[..., recorded : recorded + 1] for name, values in arrays.items()}
            scenes.append(recorded_film(row, one, rules, every=RECORD_STEPS).scenes[-1])
            recorded += 1
        yield dict.fromkeys(PICTURES) | dict(zip(PICTURES, map(_picture, scenes), strict=False)) | row


def _picture(scene: Scene) -> dict[str, Any]:
    file = io.BytesIO()
    rasterise(scene, PIXELS).save(file, "PNG", optimize=True)
    return {"bytes": file.getvalue(), "path": None}
