"""Successes: actions of an episode that reached the goal, in search or training."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.task.actions import CHOICES


class Success(NamedTuple):
    """A successful episode; every episode starts in the level's first state, so its actions reach the goal again."""

    action: Int[Array, "256 6"]  # zeros after the end
    length: Int[Array, ""]  # env steps; 0: no success


def no_success(count: int) -> Success:
    """Return empty successes for `count` levels, on the host, level first."""
    action, length = np.zeros((count, RECORD_STEPS, len(CHOICES)), np.int8), np.zeros(count, np.int32)
    return Success(action, length)  # pyright: ignore[reportArgumentType]


def remember(known: Success, new: Success) -> Success:
    """Return the known success, or the new one if none is known."""
    return jax.tree.map(lambda a, b: jnp.where(known.length > 0, a, b), known, new)


def find(
    recent: Int[Array, "history 6 environment"],
    goal: Bool[Array, "time environment"],
    timestep: Int[Array, "time environment"],
) -> Success:
    """Find the first success of a rollout that fits a record, if any.

    Args:
        recent: latest actions, ending with those of the rollout.
        goal: whether each step of the rollout reached the goal.
        timestep: env steps of the episode before each step.
    """
    length = timestep + 1
    usable = goal & (length <= RECORD_STEPS)
    at = jnp.argmax(usable.reshape(-1))
    time, environment = jnp.divmod(at, goal.shape[1])
    steps = jnp.where(usable.any(), length[time, environment], 0)
    return ending_at(recent, len(recent) - len(goal) + time, environment, steps)


def ending_at(
    action: Int[Array, "time 6 lane"], time: Int[Array, ""], lane: Int[Array, ""], steps: Int[Array, ""]
) -> Success:
    """Cut the `steps` actions of a lane that end at `time`; 0 steps: no success."""
    row = jnp.arange(RECORD_STEPS)
    taken = action[jnp.clip(time + 1 - steps + row, 0, len(action) - 1), :, lane]
    return Success(jnp.where((row < steps)[:, None], taken, 0).astype(jnp.int8), steps.astype(jnp.int32))
