"""Episodes for offline RL, cut from records: flat observations, one more than actions, rewards and ends.

No record contains the observation after an episode's last step, because its next row is the level's start again: the
engine recomputes that step.
"""

from collections.abc import Iterator
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.batching import blocks, merge_steps, take
from levelproof.levelgen.level import MOTOR_BINDINGS, Level
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.levelgen.task.rules import TaskParams, TaskState, advance

BLOCK = 16  # records per call of the compiled program


class ActionKind(StrEnum):
    """Encoding of actions; each is lossless."""

    MULTI_DISCRETE = "multi_discrete"  # six integer codes, as in records
    COMBINED = "combined"  # one integer for all six codes, by numpy.ravel_multi_index
    CONTINUOUS = "continuous"  # six floats in [-1, 1] (motors) and [0, 1] (thrusters), for the environment


class Episode(NamedTuple):
    """One episode of a level; numpy arrays."""

    level_id: int
    observations: Float[np.ndarray, "step+1 feature"]  # symbolic_flat
    actions: Num[np.ndarray, "step ..."]
    rewards: Float[np.ndarray, " step"]
    terminations: Bool[np.ndarray, " step"]  # green touched blue or red
    truncations: Bool[np.ndarray, " step"]  # the time limit or the end of the record
    success: Bool[np.ndarray, " step"]  # green touched blue
    action_mask: Bool[np.ndarray, "6"]  # entries of an action to which an unfixed joint or a thruster is bound


def episodes_of(
    level_ids: Int[np.ndarray, " level"], level: Level, record: Record, rules: TaskParams, kind: ActionKind
) -> Iterator[Episode]:
    """Yield the episodes of records, level by level.

    Args:
        level_ids: ids of the levels.
        level: levels, level axis last.
        record: one record per level; time first, level last.
        rules: task rules that the records were played by.
        kind: encoding of the actions.
    """
    for lanes in blocks(len(level_ids), BLOCK):
        some_levels, some_records = take(level, lanes), take(record, lanes)
        before, after = map(np.asarray, _observe(some_levels, some_records, rules))
        mask = np.asarray(action_mask(jax.tree.map(jnp.asarray, some_levels)))
        for i in range(len(dict.fromkeys(lanes.tolist()))):  # a last block repeats its last level
            one = take(some_records, np.array(i))
            ends = np.append(np.flatnonzero(one.done[:-1]), RECORD_STEPS - 1) + 1
            for first, end in zip([0, *ends], ends, strict=False):
                steps = slice(first, end)
                yield _episode(int(level_ids[lanes[i]]), one, steps, before[i], after[i], mask[:, i], rules, kind)


def _episode(
    level_id: int, record: Any, steps: slice, before: np.ndarray, after: np.ndarray, mask, rules, kind
) -> Episode:
    """Make an episode of some steps of one level's record."""
    done, goal = record.done[steps], record.goal[steps]
    late = done & ~goal & (record.timestep[steps] + 1 >= rules.max_timesteps)
    truncated = late.copy()
    truncated[-1] |= not done[-1]  # the record ends before the episode
    return Episode(
        level_id,
        np.concatenate([before[steps], after[steps][-1:]]),
        encode_actions(record.action[steps], kind),
        record.reward[steps],
        done & ~late,
        truncated,
        goal,
        mask,
    )


def encode_actions(action: Int[np.ndarray, "step 6"], kind: ActionKind) -> Num[np.ndarray, "step ..."]:
    """Encode the actions of a record: int64, or float32 if continuous."""
    if kind == ActionKind.MULTI_DISCRETE:
        return action.astype(np.int64)
    if kind == ActionKind.COMBINED:
        return np.asarray(np.ravel_multi_index(tuple(action.T), CHOICES))
    values = action.astype(np.float32)
    motors = values[:, :MOTOR_BINDINGS]
    motors[motors == 2] = -1.0  # backward
    return values


@partial(jax.jit, static_argnames="rules")
def _observe(level: Level, record: Record, rules: TaskParams) -> tuple[Array, Array]:
    """Observe before and after each step, [level, step, feature]; every step is a lane."""
    repeated = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), RECORD_STEPS, axis=-1), level)
    state, timestep, last_distance, action = merge_steps(
        (record.state, record.timestep, record.last_distance, record.action)
    )
    after, _ = advance(repeated, TaskState(state, timestep, last_distance), action, rules)
    split = lambda features: jnp.moveaxis(features.reshape(len(features), -1, RECORD_STEPS), 0, -1)
    return split(symbolic_flat(repeated, state)), split(symbolic_flat(repeated, after.state))
