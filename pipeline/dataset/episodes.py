"""First episodes without the rest of their records: env steps as rows, one episode after another.

Of a record of 256 steps, what follows the first episode repeats it or is another success in the same level. Learners
that want each transition once read first episodes; of seeds, only these are simulated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.physics.types import State
from levelproof.pipeline.dataset.observations import observe_rows
from levelproof.pipeline.read.rows import Open, parts_of
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.seed.shard import SeedEpisodes, SeedShard, play_seeds
from levelproof.pipeline.store.shard import Part, Report, read_together, report_unlike

STATE, ACTION, REWARD, DONE, GOAL = (f"record/{name}" for name in ("state", "action", "reward", "done", "goal"))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EpisodeBatch:
    """First episodes of trajectories as numpy arrays: env steps are rows, one episode after another.

    Every episode ends at the goal, so the reward after its last row is 0. A row holds the observation, the action taken
    from it, and that action's reward.

    Attributes:
        level_id: ids of the levels, int64 [episode].
        steps: lengths of the episodes, env steps, int64 [episode].
        episode: which episode each row belongs to, int64 [row].
        mask: bool [row]; False for padding (`Dataset.episode_batches`), whose episodes repeat others, and for levels
            that are left out (`levelproof.open`).
        observation: of the requested type, [row, ...] (`symbolic_flat`: float32 [row, feature]); None if none was
            requested.
        action: multi-discrete codes (`levelgen.task.actions`), int32 [row, 6].
        action_mask: entries of an action to which an unfixed joint or a thruster is bound, bool [row, 6].
        reward: float32 [row].
        done: whether the row is the last of its episode, bool [row].
        fields: the other requested fields by name: `level/` fields [episode, ...], `record/` fields [row, ...].
    """

    level_id: Int[np.ndarray, " episode"]
    steps: Int[np.ndarray, " episode"]
    episode: Int[np.ndarray, " row"]
    mask: Bool[np.ndarray, " row"]
    observation: Any
    action: Int[np.ndarray, "row 6"]
    action_mask: Bool[np.ndarray, "row 6"]
    reward: Float[np.ndarray, " row"]
    done: Bool[np.ndarray, " row"]
    fields: dict[str, np.ndarray]

    def parts(self, size: int) -> list["EpisodeBatch"]:
        """Divide into groups of `size` episodes; the last may have fewer. Arrays are views."""
        ends = np.cumsum(self.steps)
        groups = []
        for first in range(0, len(self.steps), size):
            some = slice(first, first + size)
            rows = slice(int(ends[first] - self.steps[first]), int(ends[some][-1]))
            cut = lambda x, rows=rows: x[rows]
            groups.append(
                EpisodeBatch(
                    self.level_id[some], self.steps[some], self.episode[rows] - first, self.mask[rows],
                    jax.tree.map(cut, self.observation), self.action[rows], self.action_mask[rows], self.reward[rows],
                    self.done[rows],
                    {name: x[some if name.startswith("level/") else rows] for name, x in self.fields.items()},
                )
            )  # fmt: skip
        return groups


def gather_episodes(
    split: Path, rows: pa.Table, fields: Sequence[str], kind: ObservationType | None, opened: Open, report: Report
) -> EpisodeBatch:
    """Read the first episodes of manifest rows (with `read.rows.COLUMNS`).

    Args:
        split: path or URL of the split.
        rows: the rows, all with a trajectory.
        fields: names of further fields.
        kind: type of the observation; None: none.
        opened: opens a shard, as in `read.rows.gather_rows`.
        report: called if states differ on this machine from the stored ones.

    Raises:
        Failure: a shard is missing or damaged, or its levels differ from the manifest; or as `report`.
    """
    parts, places = parts_of(split, rows, opened)
    size = parts[0][0].size
    levels = [field.name for field in table_for(size) if field.name.startswith("level/")]
    names = list(dict.fromkeys([*levels, *fields, ACTION, REWARD, DONE]))
    if all(isinstance(shard, SeedShard) and shard.encoding == parts[0][0].encoding for shard, _ in parts):
        seeds: Any = parts
        made = play_seeds(seeds, places, names, kind)
        report_unlike(parts, places, np.where(made.wrong, 0, -1), report)
    else:
        made = _cut(parts, places, names, kind, report)
    episode = np.repeat(np.arange(len(made.steps)), made.steps)
    level = tree_of(Level, made.level, "level/")
    live = action_mask(jax.tree.map(lambda x: np.moveaxis(x, 0, -1), level)).T
    return EpisodeBatch(
        level_id=rows["level_id"].to_numpy(),
        steps=made.steps.astype(np.int64),
        episode=episode,
        mask=np.ones(len(episode), bool),
        observation=made.observation,
        action=made.rows[ACTION],
        action_mask=np.asarray(live)[episode],
        reward=made.rows[REWARD],
        done=made.rows[DONE],
        fields={name: (made.level | made.rows)[name] for name in fields},
    )


def _cut(
    parts: Sequence[Part],
    places: Sequence[Sequence[int]],
    names: Sequence[str],
    kind: ObservationType | None,
    report: Report,
) -> SeedEpisodes:
    """Read whole records and keep their first episodes."""
    states = [field.name for field in table_for(parts[0][0].size) if kind and field.name.startswith(f"{STATE}/")]
    arrays = read_together(parts, [*names, *states], report, places)
    done = arrays[DONE]
    steps = np.where(done.any(1), done.argmax(1) + 1, done.shape[1])
    kept = np.arange(done.shape[1]) < steps[:, None]
    level = {name: x for name, x in arrays.items() if name.startswith("level/")}
    rows = {name: x[kept] for name, x in arrays.items() if name not in level}
    shown = None
    if kind is not None:
        row_level = np.repeat(np.arange(len(steps)), steps)
        shown = observe_rows(kind, tree_of(Level, level, "level/"), row_level, tree_of(State, rows, f"{STATE}/"))
    wanted = {name: x for name, x in rows.items() if name in names}
    return SeedEpisodes(level, steps, wanted, shown, np.zeros(len(steps), bool))
