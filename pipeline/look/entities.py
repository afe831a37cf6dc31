"""Share of levels solved by number of bodies, joints, motors and thrusters; of a sample if there are many levels.

No column counts entities: random levels are resampled from their ids, others are read from shards and level files.
"""

from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from levelproof.configs.schema import from_files
from levelproof.experts.labels import TRAINED, Label
from levelproof.levelgen.level import Level
from levelproof.physics.types import FIXED_POLYGONS
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.read.levels import COLUMNS, levels_of
from levelproof.pipeline.read.select import labelled
from levelproof.pipeline.store.manifest import Manifest, require_manifest

ENTITIES = ("bodies", "joints", "motors", "thrusters")
SAMPLED, READ = 4096, 256  # maximum sample: levels resampled from their ids, levels read
MANY = 1_000_000  # levels; above, nothing is sampled


def count_entities(level: Level) -> dict[str, Int[np.ndarray, " level"]]:
    """Count each level's bodies (without scenery), joints (fixed ones too), motors that are on, and thrusters."""
    model = level.model
    joints, motors = np.asarray(model.joint_active), np.asarray(model.motor_on) & ~np.asarray(model.joint_fixed)
    bodies, thrusters = np.asarray(model.active)[FIXED_POLYGONS:], np.asarray(model.thruster_active)
    counts = (x.sum(0, dtype=np.int32) for x in (bodies, joints, joints & motors, thrusters))
    return dict(zip(ENTITIES, counts, strict=True))


def solved_by_entities(manifest: Manifest, ids: np.ndarray) -> dict[str, Any]:
    """Return, by kind of entity and by count, the share solved of the trained levels with that count.

    `ids` are ascending. Only the first SAMPLED (or READ) levels are counted: levels are independent of their ids.
    `problem` says why there are no shares: levels cannot be read, or there are more than MANY, which would take long.
    """
    if len(ids) > MANY:
        problem = f"not computed for more than {MANY:,} levels: choose some with --where"
        return {"levels": 0, "sampled": 0, "of": len(ids), "problem": problem}
    read = from_files(manifest.config or {})
    most = min(READ if read else SAMPLED, len(ids))
    rows = require_manifest(manifest.split, COLUMNS, ids[:most]).table
    rows = rows.filter(pa.array(labelled(rows, TRAINED)))
    facts: dict[str, Any] = {"levels": rows.num_rows, "sampled": most, "of": len(ids), "problem": None}
    if not rows.num_rows:
        return facts
    if not read:  # ids suffice: read no shards
        index = rows.schema.get_field_index("shard")
        rows = rows.set_column(index, "shard", pa.nulls(rows.num_rows, pa.string()))
    solved = labelled(rows, [Label.SOLVED])
    try:
        levels = levels_of(manifest, rows)
    except (Failure, UserError) as error:  # the other facts need only the manifest
        return facts | {"levels": 0, "problem": str(error)}
    for name, counts in count_entities(levels).items():
        facts[name] = {
            str(count): as_json(Share(int(solved[counts == count].sum()), int((counts == count).sum())))
            for count in np.unique(counts)
        }
    return facts


def as_json(share: Share) -> dict[str, Any]:
    """Convert a share to JSON types, with its 95% interval."""
    return {"solved": share.hits, "tried": share.total, "interval": share.rounded}
