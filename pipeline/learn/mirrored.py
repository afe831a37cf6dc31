"""Mirror images of witnesses, replayed: rounding and the solver's order are not symmetric, so not all of them solve."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.level import Level
from levelproof.levelgen.mirror import mirror, mirror_actions
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.dataset.batch import Batch

STATE = "record/state/"


class Witnesses(NamedTuple):
    """Records of levels; the level axis is first, time second."""

    level: Level
    fields: Sequence[np.ndarray]  # of states, in the order of the caller's `names`
    done: Bool[np.ndarray, "level time"]
    action: Int[np.ndarray, "level time 6"]


def mirrored(batch: Batch, names: Sequence[str], whole: bool, rules: TaskParams) -> Witnesses:
    """Mirror and replay the records of a batch; keep those that solve their mirrored level.

    Args:
        batch: whole records with their levels.
        names: fields of states to return, such as `record/state/position`.
        whole: whether every episode of a record must reach the goal, or only the first.
        rules: the task's rules.
    """
    image = mirror(jax.tree.map(lambda x: np.moveaxis(x, 0, -1), batch.level))
    actions = mirror_actions(batch.action)
    record = replay(image, actions.transpose(1, 2, 0), rules)
    done, goal = np.asarray(record.done), np.asarray(record.goal)
    first = done.argmax(0), np.arange(done.shape[1])
    kept = succeeds(done, goal) if whole else done.any(0) & goal[first]
    by_level = lambda x: np.moveaxis(np.asarray(x), -1, 0)[kept]
    fields = [by_level(getattr(record.state, name.removeprefix(STATE))) for name in names]
    return Witnesses(jax.tree.map(by_level, image), fields, by_level(done), actions[kept])
