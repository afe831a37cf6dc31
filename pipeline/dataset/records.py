"""Records of seeds: first episodes, repeated up to the steps of a record.

Only first episodes are simulated and observed. The rest are copies, made when a batch is returned.
"""

from collections.abc import Iterable

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.witness.episode import repeated_rows
from levelproof.pipeline.dataset.batch import Batch, timed_out
from levelproof.pipeline.dataset.episodes import EpisodeBatch
from levelproof.pipeline.dataset.windows import Windows

GOAL = "record/goal"


def repeat(
    episodes: EpisodeBatch, first: Int[np.ndarray, " batch"], windows: Windows, fields: Iterable[str], limit: int
) -> Batch:
    """Return windows of the records that repeat these episodes.

    Args:
        episodes: the episodes; among their fields are `record/goal` and those of `fields`.
        first: step of the record at which each window starts.
        windows: their length.
        fields: names of the fields to return.
        limit: env steps after which the task ends an episode.
    """
    rows = repeated_rows(episodes.steps)  # of whole records
    late = timed_out(episodes.done[rows], episodes.fields[GOAL][rows], limit)
    rows, late = windows.cut({"record/row": rows, "record/late": late}, first).values()
    take = lambda x: x.take(rows, 0)
    done = take(episodes.done)
    return Batch(
        level_id=episodes.level_id,
        first=first,
        mask=windows.mask(first) & take(episodes.mask),
        observation=jax.tree.map(take, episodes.observation),
        action=take(episodes.action),
        action_mask=take(episodes.action_mask),
        reward=take(episodes.reward),
        done=done,
        terminated=done & ~late,
        truncated=late,
        goal=take(episodes.fields[GOAL]),
        fields={
            name: take(episodes.fields[name]) if name.startswith("record/") else episodes.fields[name]
            for name in fields
        },
    )
