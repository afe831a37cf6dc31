"""Windows of records with their observations, from whatever shards hold them.

A record from a seed repeats its first episode, so only that episode is observed, as it is simulated.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from levelproof.experts.witness.episode import repeat_episodes
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.physics.types import State
from levelproof.pipeline.dataset.batch import timed_out
from levelproof.pipeline.dataset.observations import observe
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.read.rows import Open, parts_of
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.seed.shard import play_seeds, seeds_alike
from levelproof.pipeline.store.shard import Report, read_together, report_unlike

STATE, DONE, GOAL, TRUNCATED = "record/state", "record/done", "record/goal", "record/truncated"
OBSERVATION = "record/observation"  # its name while windows are cut


def gather_windows(
    split: Path,
    rows: pa.Table,
    windows: Windows,
    first: Int[np.ndarray, " row"],
    fields: Sequence[str],
    kind: ObservationType | None,
    limit: int,
    opened: Open,
    report: Report,
) -> tuple[dict[str, np.ndarray], Any]:
    """Read a window of the record of each manifest row (with `read.rows.COLUMNS`), and observe it.

    Args:
        split: path or URL of the split.
        rows: the rows, all with a trajectory.
        windows: what the windows are like.
        first: step of the record at which each window starts.
        fields: names of fields: all of `level/`, `record/done` and `record/goal` among them.
        kind: type of the observation; None: none.
        limit: env steps after which the task ends an episode.
        opened: opens a shard, as in `read.rows.gather_rows`.
        report: called if states differ on this machine from the stored ones.

    Returns:
        The fields and `record/truncated` (`timed_out`) by name: `level/` fields [row, ...], others [row, time, ...];
        and observations, numpy arrays [row, time, ...], or None.

    Raises:
        Failure: a shard is missing or damaged, or its levels differ from the manifest; or as `report`.
    """
    parts, places = parts_of(split, rows, opened)
    seeds = None if kind == ObservationType.PIXELS and not windows.whole else seeds_alike(parts)
    if seeds is not None:
        made = play_seeds(seeds, places, fields, kind)
        report_unlike(parts, places, np.where(made.wrong, 0, -1), report)
        records, shown = repeat_episodes((made.rows, made.observation), made.steps)
        arrays = made.level | records
    else:
        states = [field.name for field in table_for(parts[0][0].size) if kind and field.name.startswith(f"{STATE}/")]
        arrays, shown = read_together(parts, [*fields, *states], report, places), None
    arrays = arrays | {TRUNCATED: timed_out(arrays[DONE], arrays[GOAL], limit), OBSERVATION: shown}
    arrays = windows.cut(arrays, first)
    shown = arrays.pop(OBSERVATION)
    if kind is not None and seeds is None:
        shown = observe(kind, tree_of(Level, arrays, "level/"), tree_of(State, arrays, f"{STATE}/"))
    return arrays, shown
