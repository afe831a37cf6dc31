"""Records as episodes of offline RL: flat observations, one more than actions; rewards, ends, and what is beside them.

A record is cut where its episodes end. What is seen after an episode's last step stands in no record, because the next
row is the level's start again: the engine makes that step anew.
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
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import MOTOR_BINDINGS, Level
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.levelgen.task.rules import TaskParams, TaskState, advance

BLOCK = 16  # records that are looked at together, in one compiled program


class ActionKind(StrEnum):
    """How an action is written. Each of these tells every action of a witness from every other."""

    MULTI_DISCRETE = "multi_discrete"  # six whole numbers, as in records
    COMBINED = "combined"  # one number for all six: of numpy.ravel_multi_index
    CONTINUOUS = "continuous"  # six numbers in [-1, 1] (motors) and [0, 1] (thrusters), as the environment takes them


class Episode(NamedTuple):
    """One episode of a level; numpy arrays."""

    level_id: int
    observations: Float[np.ndarray, "step+1 feature"]  # symbolic_flat
    actions: Num[np.ndarray, "step ..."]
    rewards: Float[np.ndarray, " step"]
    terminations: Bool[np.ndarray, " step"]  # green touched blue or red
    truncations: Bool[np.ndarray, " step"]  # time was up, or the record
    success: Bool[np.ndarray, " step"]  # green touched blue
    action_mask: Bool[np.ndarray, "6"]  # entries of an action that something in the level obeys


def episodes_of(
    level_ids: Int[np.ndarray, " level"], level: Level, record: Record, rules: TaskParams, kind: ActionKind
) -> Iterator[Episode]:
    """The episodes of these levels' records, in their order.

    Args:
        level_ids: ids of the levels.
        level: level axis last.
        record: of each level; time first, level last.
        rules: by which the records were played.
        kind: of the actions.
    """
    for lanes in blocks(len(level_ids), BLOCK):
        some_level, some = take(level, lanes), take(record, lanes)
        before, after = (np.asarray(seen) for seen in _seen(some_level, some, rules))
        mask = np.asarray(action_mask(jax.tree.map(jnp.asarray, some_level)))
        for i in range(len(dict.fromkeys(lanes.tolist()))):  # a last block repeats its last level
            one = take(some, np.array(i))
            ends = np.append(np.flatnonzero(one.done[:-1]), RECORD_STEPS - 1) + 1
            for first, end in zip([0, *ends], ends, strict=False):
                steps = slice(first, end)
                yield _episode(int(level_ids[lanes[i]]), one, steps, before[i], after[i], mask[:, i], rules, kind)


def _episode(
    level_id: int, record: Any, steps: slice, before: np.ndarray, after: np.ndarray, mask, rules, kind
) -> Episode:
    """Some steps of one level's record."""
    done, goal = record.done[steps], record.goal[steps]
    late = done & ~goal & (record.timestep[steps] + 1 >= rules.max_timesteps)
    truncated = late.copy()
    truncated[-1] |= not done[-1]  # the record is over, the episode is not
    return Episode(
        level_id,
        np.concatenate([before[steps], after[steps][-1:]]),
        written(record.action[steps], kind),
        record.reward[steps],
        done & ~late,
        truncated,
        goal,
        mask,
    )


def written(action: Int[np.ndarray, "step 6"], kind: ActionKind) -> Num[np.ndarray, "step ..."]:
    """Actions of a record in another form: int64, or float32 if continuous."""
    if kind == ActionKind.MULTI_DISCRETE:
        return action.astype(np.int64)
    if kind == ActionKind.COMBINED:
        return np.asarray(np.ravel_multi_index(tuple(action.T), CHOICES))
    number = action.astype(np.float32)
    motors = number[:, :MOTOR_BINDINGS]
    motors[motors == 2] = -1.0  # backward
    return number


@partial(jax.jit, static_argnames="rules")
def _seen(level: Level, record: Record, rules: TaskParams) -> tuple[Array, Array]:
    """What is seen before and after each step, [level, step, feature]: every step is a lane."""
    lanes = lambda x: jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], -1)
    at = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), RECORD_STEPS, axis=-1), level)
    state, timestep, last_distance, action = jax.tree.map(
        lanes, (record.state, record.timestep, record.last_distance, record.action)
    )
    after, _ = advance(at, TaskState(state, timestep, last_distance), action, rules)
    first = lambda seen: jnp.moveaxis(seen.reshape(len(seen), -1, RECORD_STEPS), 0, -1)
    return first(symbolic_flat(at, state)), first(symbolic_flat(at, after.state))
