"""The experts that a split kept (`keep_experts`), as teachers of its levels."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int

from levelproof.configs.convert import typed
from levelproof.configs.schema import JobConfig
from levelproof.experts.config import ExpertConfig, StopConfig
from levelproof.experts.generalist.teachers import KnownExperts, no_experts
from levelproof.levelgen.batching import stacked
from levelproof.pipeline.read.levels import recorded_settings
from levelproof.pipeline.store.checkpoints import load_experts
from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.urls import as_typed, is_remote

WITHOUT = "set teachers.expert=0 and demonstrations=0 to do without them"


def experts_of(split: Path, level_ids: Int[np.ndarray, " level"], tell: Callable[[str], None]) -> KnownExperts:
    """Load the experts of these levels; none if the split is a seed file or remote, with a notice if it kept some.

    Raises:
        UserError: other users can write to the experts.
        Failure: they are damaged or missing, or another version wrote them.
    """
    if is_seed(split):
        return no_experts(len(level_ids))
    manifest = require_manifest(split, ["experts", "size"], level_ids)
    rows = manifest.table.to_pylist()
    if is_remote(split):
        if any(row["experts"] for row in rows):
            tell(f"The experts kept in {as_typed(split)} are not used: copy the split to this machine to use them.")
        return no_experts(len(level_ids))
    by_file: dict[str, list[int]] = defaultdict(list)
    for row in rows:
        if row["experts"]:
            by_file[row["experts"]].append(row["level_id"])
    if not by_file:
        return no_experts(len(level_ids))
    with recorded_settings(split):
        known = manifest.config or {}
        config, stop = typed(ExpertConfig, known["expert"], "expert"), typed(StopConfig, known["stop"], "stop")
        # `level_files` skips the check that a distribution can make this size: the levels exist already
        job = JobConfig(
            size=rows[0]["size"], budget=str(known["budget"]), level_files=str(split), expert=config, stop=stop
        )
    params = {}
    for name, ids in by_file.items():
        experts = load_experts(data_path(split, name), job, ids, WITHOUT)
        params |= {i: experts[i].begun.training.train_state.params for i in ids}
    row_of = {level_id: row for row, level_id in enumerate(params)}
    expert = np.array([row_of.get(level_id, -1) for level_id in level_ids.tolist()])
    return KnownExperts(config, stacked(params.values()), expert)
