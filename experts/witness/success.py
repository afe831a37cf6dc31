"""Successes: the actions of an episode that reached the goal, of search or training."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.task.actions import CHOICES


class Success(NamedTuple):
    """A successful episode; episodes start in the level's own state, so its actions reach the goal again."""

    action: Int[Array, "256 6"]  # zeros after its end
    length: Int[Array, ""]  # env steps; 0: there is none


def no_success(count: int) -> Success:
    """None for each of so many levels, on the host, level first."""
    action, length = np.zeros((count, RECORD_STEPS, len(CHOICES)), np.int8), np.zeros(count, np.int32)
    return Success(action, length)  # pyright: ignore[reportArgumentType]


def remember(known: Success, new: Success) -> Success:
    """The first one stays."""
    return jax.tree.map(lambda a, b: jnp.where(known.length > 0, a, b), known, new)


def find(
    recent: Int[Array, "history 6 environment"],
    goal: Bool[Array, "time environment"],
    timestep: Int[Array, "time environment"],
) -> Success:
    """The first success of a rollout, if there is one that a record can hold.

    Args:
        recent: actions, those of the rollout last.
        goal: steps of the rollout that reached the goal.
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
    """So many actions of a lane, the last of them at this time; 0: there is no success."""
    row = jnp.arange(RECORD_STEPS)
    taken = action[jnp.clip(time + 1 - steps + row, 0, len(action) - 1), :, lane]
    return Success(jnp.where((row < steps)[:, None], taken, 0).astype(jnp.int8), steps.astype(jnp.int32))
