"""What training showed, per level: returns, first success. Kept on the device while an expert trains."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

NEVER = -1  # no success yet


class Progress(NamedTuple):
    """Running totals of every level."""

    episode_return: Float[Array, "level environment"]  # of the episodes under way, shaping included
    best_return: Float[Array, " level"]  # of the episodes that ended; -inf: none
    episodes: Int[Array, " level"]  # that ended
    env_steps: Int[Array, ""]  # taken for each level
    first_success: Int[Array, " level"]  # env steps taken until then; NEVER


def start(levels: int, environments: int) -> Progress:
    return Progress(
        jnp.zeros((levels, environments)),
        jnp.full(levels, -jnp.inf, jnp.float32),
        jnp.zeros(levels, jnp.int32),
        jnp.int32(0),
        jnp.full(levels, NEVER, jnp.int32),
    )


def follow(
    progress: Progress,
    reward: Float[Array, "time level environment"],
    done: Bool[Array, "time level environment"],
    goal: Bool[Array, "time level environment"],
) -> tuple[Progress, Float[Array, " level"]]:
    """Add one rollout.

    Returns:
        The totals, and the share of the rollout's finished episodes that reached the goal (NaN: none finished).
    """
    steps, _, environments = reward.shape

    def add(running, now):
        reward, done = now
        running += reward
        return jnp.where(done, 0.0, running), jnp.where(done, running, -jnp.inf)

    running, ended_returns = jax.lax.scan(add, progress.episode_return, (reward, done))
    ended, reached = done.sum((0, 2)), goal.sum((0, 2))
    any_goal = goal.any(2)
    when = progress.env_steps + (jnp.argmax(any_goal, axis=0) + 1) * environments
    first = jnp.where((progress.first_success == NEVER) & any_goal.any(0), when, progress.first_success)
    after = Progress(
        running,
        jnp.maximum(progress.best_return, ended_returns.max((0, 2))),
        progress.episodes + ended,
        progress.env_steps + steps * environments,
        first,
    )
    return after, jnp.where(ended > 0, reached / jnp.maximum(ended, 1), jnp.nan)
