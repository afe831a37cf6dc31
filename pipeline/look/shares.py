"""Which levels are solved: the share by what they are made of, on a sample of them where they are many.

What a level is made of is in no column: random levels are made again from their ids, others read from their shards and
files.
"""

from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.configs.schema import from_files
from levelproof.experts.labels import TRAINED, Label
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.look.things import things_of
from levelproof.pipeline.read.levels import COLUMNS, levels_of
from levelproof.pipeline.store.manifest import Manifest, require_manifest

SAMPLED, READ = 4096, 256  # levels that are looked at: made again from their ids, or read
MANY = 1_000_000


def solved_by_things(manifest: Manifest, ids: np.ndarray) -> dict[str, Any]:
    """For each kind of thing and each count of it: how many levels that could use an expert have it, and are solved.

    `ids` are ascending; of many, the first SAMPLED are looked at: levels of low ids are like all others. Levels that
    cannot be read are a `problem`, and so are more than MANY, of which other answers take long enough.
    """
    if len(ids) > MANY:
        problem = f"nobody looks into more than {MANY:,} levels: choose some with --where"
        return {"levels": 0, "looked_at": 0, "of": len(ids), "problem": problem}
    read = from_files(manifest.config or {})
    most = min(READ if read else SAMPLED, len(ids))
    rows = require_manifest(manifest.split, COLUMNS, ids[:most]).table
    tried = np.isin(rows["label"].to_pylist(), [label.value for label in TRAINED])
    rows = rows.filter(pa.array(tried))
    found: dict[str, Any] = {"levels": rows.num_rows, "looked_at": most, "of": len(ids), "problem": None}
    if not rows.num_rows:
        return found
    if not read:  # no shard is read where an id makes the level
        at = rows.schema.get_field_index("shard")
        rows = rows.set_column(at, "shard", pa.nulls(rows.num_rows, pa.string()))
    solved = np.array([label == Label.SOLVED for label in rows["label"].to_pylist()])
    try:
        levels = levels_of(manifest, rows)
    except (Failure, UserError) as error:  # the manifest has the other answers
        return found | {"levels": 0, "problem": str(error)}
    for name, counts in things_of(levels).items():
        found[name] = {
            str(count): as_json(Share(int(solved[counts == count].sum()), int((counts == count).sum())))
            for count in np.unique(counts)
        }
    return found


def as_json(share: Share) -> dict[str, Any]:
    """A share with its 95% interval."""
    return {"solved": share.hits, "tried": share.of, "interval": share.rounded}
