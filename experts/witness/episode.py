"""First episodes played again, and the records that repeat them.

A record whose later episodes have the actions of the first one repeats it, bit for bit, because every episode starts in
the level's first state. So the first episode is simulated, and the rest is copied.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.resume import checksum, paths_of
from levelproof.experts.witness.witness import record_of
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold

# Lanes of a block, which ends with its longest episode. With more, most lanes would wait for the last one; with fewer
# than the engine's kernel steps together, a block would be no faster
SIDE_BY_SIDE = 16
DISTANCE = "last_distance"


class PlayedEpisodes(NamedTuple):
    """First episodes, level axis last. What lies after the last step of an episode has no meaning."""

    fields: dict[str, Any]  # arrays of `Record` by path, [256, ..., level]
    checksum: UInt32[np.ndarray, " level"]  # of `checksum_of`
    reaches: Any  # bool [level]: whether the episode ends at its last step and not before, at the goal


class _FirstEpisode(NamedTuple):
    step: Int[Array, ""]
    now: TaskState
    manifold: Any
    reaches: Bool[Array, " lane"]
    fields: dict[str, Array]


def play_episodes(
    level: Level,
    action: Int[np.ndarray, "256 6 level"],
    steps: Int[np.ndarray, " level"],
    rules: TaskParams,
    fields: frozenset[str],
) -> PlayedEpisodes:
    """Play first episodes, those of similar length side by side.

    Args:
        level: levels, level axis last.
        action: the actions.
        steps: lengths of the episodes, env steps, 1 to 256.
        rules: the task's rules.
        fields: paths of `Record` to return; anything else is not kept.
    """
    count = len(steps)
    order = np.argsort(steps, kind="stable")
    given = take((level, action, steps.astype(np.int32)), order)
    parts = [jax.device_get(_play_block(*take(given, lanes), rules, fields)) for lanes in blocks(count, SIDE_BY_SIDE)]
    back = np.argsort(order)
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1)[..., :count][..., back], *parts)


@partial(jax.jit, static_argnames=("rules", "fields"))
def _play_block(
    level: Level,
    action: Int[Array, "256 6 lane"],
    steps: Int[Array, " lane"],
    rules: TaskParams,
    fields: frozenset[str],
) -> PlayedEpisodes:
    with_contacts = any(name.startswith("manifold/") for name in fields)

    def act(playing: _FirstEpisode) -> _FirstEpisode:
        step, now = playing.step, playing.now
        taken = action[step]
        after, outcome, _, contacts = task.advance_driven(level, now, controls(level, taken), rules, with_contacts)
        made = paths_of(record_of(level, now, playing.manifold, taken, outcome))
        last = step == steps - 1
        right = (outcome.done == last) & (outcome.goal == last)
        return _FirstEpisode(
            step + 1,
            after,
            contacts,
            playing.reaches & (right | (step >= steps)),
            {name: jax.lax.dynamic_update_index_in_dim(x, made[name], step, 0) for name, x in playing.fields.items()},
        )

    start = task.reset(level)
    contacts = zeros_of(Manifold, level.size, len(steps)) if with_contacts else None
    row = jax.eval_shape(
        lambda: paths_of(record_of(level, start, contacts, action[0], task.step(level, start, action[0], rules)[1]))
    )
    states = [f"state/{name}" for name in paths_of(start.state)]
    checked = {*states, DISTANCE}  # by the checksum
    empty = {name: jnp.zeros((RECORD_STEPS, *x.shape), x.dtype) for name, x in row.items() if name in fields | checked}
    begun = _FirstEpisode(jnp.int32(0), start, contacts, jnp.ones(len(steps), bool), empty)
    over = jax.lax.while_loop(lambda playing: playing.step < steps.max(), act, begun)
    at_end = lambda name: jnp.take_along_axis(over.fields[name], _along(steps - 1, over.fields[name]), 0)[0]
    leaves = [at_end(name) for name in states]
    end = TaskState(jax.tree.unflatten(jax.tree.structure(start.state), leaves), steps - 1, at_end(DISTANCE))
    kept = {name: x for name, x in over.fields.items() if name in fields}
    return PlayedEpisodes(kept, _checksum(start, end, steps), over.reaches)


def _along(step: Any, rows: Any) -> Any:
    """Reshape a step of each lane to index the rows of an array [step, ..., lane]."""
    return step.reshape(-1, *(1,) * (rows.ndim - 2), rows.shape[-1])


def _checksum(start: TaskState, end: TaskState, steps: Any) -> Any:
    """Checksum the first state of an episode and the one before its last action, without a time axis."""
    row = steps.astype(np.int32)[None]
    sums = [checksum(jax.tree.map(lambda x: x[None], state), at)[0] for state, at in ((start, row * 0), (end, row - 1))]
    return sums[0] + sums[1]


def checksum_of(states: TaskState, steps: Int[np.ndarray, " level"]) -> UInt32[np.ndarray, " level"]:
    """Checksum the first state of each record and the one before the last action of its first episode.

    Args:
        states: of the records, [256, ..., level].
        steps: lengths of the first episodes, env steps.
    """
    lanes = np.arange(len(steps))
    start = jax.tree.map(lambda x: np.asarray(x)[0], states)
    end = jax.tree.map(lambda x: np.moveaxis(np.moveaxis(np.asarray(x), -1, 1)[steps - 1, lanes], 0, -1), states)
    return _checksum(start, end, steps)


def repeat_episodes(rows: np.ndarray, steps: Int[np.ndarray, " level"]) -> np.ndarray:
    """Fill records [256, ..., level] with copies of their first episodes."""
    return np.take_along_axis(rows, _along(np.arange(RECORD_STEPS)[:, None] % steps, rows), 0)
