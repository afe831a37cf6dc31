"""The queue before the slots: levels enter it in groups, with new experts or experts that continue."""

from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from levelproof.experts.config import ExpertConfig
from levelproof.experts.training.slots import ExpertState, LevelQueue, Pending, begin
from levelproof.experts.witness.success import Success, no_success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level

GROUP = 16  # levels that enter together


def empty_queue(levels: Level, capacity: int, config: ExpertConfig) -> LevelQueue:
    """Return an empty queue for levels of this size, on the host, where zeros need no compiled programs."""
    one = take(levels, np.zeros(1, int))
    begun = jax.eval_shape(partial(begin, config=config), one, jnp.zeros(1, jnp.int32), no_success(1))
    return LevelQueue(
        jax.tree.map(lambda x: np.zeros((*x.shape[:-1], capacity), x.dtype), one),
        np.zeros(capacity, np.int32),
        np.zeros(capacity, np.int32),
        np.int32(0),
        jax.tree.map(lambda x: np.zeros((capacity, *x.shape[1:]), x.dtype), begun),
        Pending(np.zeros(capacity, bool), np.zeros(capacity, bool), np.zeros(capacity, np.int32)),
    )


def enter(
    queue: LevelQueue,
    indices: Sequence[int],
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    success: Success,
    config: ExpertConfig,
    updates: int,
    begun: Mapping[int, tuple[ExpertState, Pending]] = MappingProxyType({}),
) -> LevelQueue:
    """Add at least one and at most GROUP levels to the queue.

    Args:
        queue: the queue before; donated.
        indices: free indices for the levels.
        levels: the levels, on the host, like all that follow.
        level_ids: their ids.
        success: successes that their experts rehearse from the start, level first.
        config: settings of an expert.
        updates: budget of an expert.
        begun: experts that continue, by index among these levels; they have their own successes.
    """
    count, come = len(level_ids), int(queue.come)
    padded = np.minimum(np.arange(GROUP), count - 1)  # pad the group with its last level
    group, ids = take(levels, padded), level_ids[padded]
    no = np.zeros(GROUP, bool)
    fresh = begin(group, ids, jax.tree.map(lambda x: x[padded], success), config)
    experts = fresh, Pending(no, no, np.full(GROUP, updates, np.int32))
    if begun:
        experts = jax.tree.map(np.array, experts)
        for i, expert in begun.items():
            for rows, row in zip(jax.tree.leaves(experts), jax.tree.leaves(expert), strict=True):
                rows[i] = row
    numbers = [number % queue.capacity for number in range(come, come + count)]
    nowhere = [queue.capacity] * (GROUP - count)
    queue = _put(queue, group, ids, *experts, np.array([*indices, *nowhere]), np.array(numbers + nowhere))
    return queue._replace(come=np.int32(come + count))


@partial(jax.jit, donate_argnames="queue")
def _put(
    queue: LevelQueue,
    levels: Level,
    level_ids: Int[Array, "16"],
    experts: ExpertState,
    pending: Pending,
    indices: Int[Array, "16"],
    numbers: Int[Array, "16"],
) -> LevelQueue:
    put = lambda old, new: old.at[indices].set(new, mode="drop")
    return queue._replace(
        levels=jax.tree.map(lambda old, new: old.at[..., indices].set(new, mode="drop"), queue.levels, levels),
        level_ids=put(queue.level_ids, level_ids),
        order=jnp.asarray(queue.order).at[numbers].set(indices, mode="drop"),
        begun=jax.tree.map(put, queue.begun, experts),
        pending=jax.tree.map(put, queue.pending, pending),
    )
