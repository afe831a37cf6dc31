"""Records of seeds: first episodes, repeated up to the steps of a record.

Only first episodes are simulated and observed. The rest are copies, made shortly before a batch is returned.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.witness.episode import MANY, repeated_rows
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.pipeline.dataset.batch import TRUNCATED, Batch, batch_of, timed_out
from levelproof.pipeline.dataset.episodes import ACTION, DONE, GOAL, REWARD, EpisodeBatch
from levelproof.pipeline.dataset.windows import Windows

USUAL_STEPS = 64  # most first episodes are shorter


class _Part(NamedTuple):
    """The episodes that become a batch, and the step of the record at which each window starts."""

    episodes: EpisodeBatch
    first: Int[np.ndarray, " batch"]


class Records(NamedTuple):
    """How windows of records are made of first episodes, whose fields are `fields` and `record/goal`."""

    windows: Windows
    fields: Sequence[str]  # names of those to return
    limit: int  # env steps after which the task ends an episode

    def parts(
        self, episodes: EpisodeBatch, first: Int[np.ndarray, " item"], new: Bool[np.ndarray, " item"], batch_size: int
    ) -> list[Batch | _Part]:
        """Divide episodes into batches: finished ones if windows are short, else what `finish` makes them of later.

        Whichever is smaller waits in memory.

        Args:
            episodes: one for each window.
            first: step of the record at which each window starts.
            new: False for windows that pad a batch.
            batch_size: windows per batch.
        """
        some = replace(episodes, mask=episodes.mask & new[episodes.episode]).parts(batch_size)
        parts = map(_Part, some, first.reshape(-1, batch_size))
        return [*parts] if self.windows.length > USUAL_STEPS else [*map(self.finish, parts)]

    def finish(self, part: Batch | _Part) -> Batch:
        """Return the batch that this part becomes, or the batch that it is."""
        return part if isinstance(part, Batch) else self.repeat(*part)

    def repeat(self, episodes: EpisodeBatch, first: Int[np.ndarray, " batch"]) -> Batch:
        """Return windows of the records that repeat these episodes; `first`: step at which each starts."""
        rows = repeated_rows(episodes.steps)  # of whole records
        late = timed_out(episodes.done[rows], episodes.fields[GOAL][rows], self.limit)
        rows, late = (np.take_along_axis(x, self.windows.steps(first), 1) for x in (rows, late))
        take = lambda x: x.take(rows, 0)
        stored = episodes.fields | {ACTION: episodes.action, REWARD: episodes.reward, DONE: episodes.done}
        arrays = {name: take(x) if name.startswith("record/") else x for name, x in stored.items()} | {TRUNCATED: late}
        mask, shown = self.windows.mask(first) & take(episodes.mask), jax.tree.map(take, episodes.observation)
        live = take(episodes.action_mask)
        return batch_of(arrays, episodes.level_id, first, mask, shown, live, self.fields)


def loaded_together(batch_size: int, kind: ObservationType | None) -> int:
    """Return how many batches to simulate together: enough to keep many lanes busy, but images take much memory."""
    return 1 if kind == ObservationType.PIXELS else -(-MANY // batch_size)
