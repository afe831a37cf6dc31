"""Training statistics of one level: returns, episodes, first success. They stay on the device during training."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax.typing import VariableDict as Params
from jaxtyping import Array, Bool, Float, Int

NEVER = -1  # not yet


class Progress(NamedTuple):
    """Running totals."""

    episode_return: Float[Array, " environment"]  # of unfinished episodes, shaping included
    best_return: Float[Array, ""]  # of finished episodes; -inf: none
    episodes: Int[Array, ""]  # finished
    env_steps: Int[Array, ""]
    first_success: Int[Array, ""]  # env steps until the expert's own first success; NEVER
    diverged: Int[Array, ""]  # env steps until a parameter was not finite; NEVER


def start(environments: int) -> Progress:
    never = jnp.int32(NEVER)
    return Progress(jnp.zeros(environments), jnp.float32(-jnp.inf), jnp.int32(0), jnp.int32(0), never, never)


def follow(
    progress: Progress,
    reward: Float[Array, "time environment"],
    done: Bool[Array, "time environment"],
    goal: Bool[Array, "time environment"],
    own: Bool[Array, " environment"],
) -> tuple[Progress, Float[Array, ""]]:
    """Add one rollout.

    Returns:
        The totals, and the share of finished episodes that reached the goal in environments whose actions the expert
        alone chose (NaN: none finished).
    """
    steps, environments = reward.shape

    def add(running, now):
        reward, done = now
        running += reward
        return jnp.where(done, 0.0, running), jnp.where(done, running, -jnp.inf)

    running, ended_returns = jax.lax.scan(add, progress.episode_return, (reward, done))
    ended, reached = (done & own).sum(), (goal & own).sum()
    any_goal = (goal & own).any(1)
    when = progress.env_steps + (jnp.argmax(any_goal) + 1) * environments
    first = jnp.where((progress.first_success == NEVER) & any_goal.any(), when, progress.first_success)
    after = Progress(
        running,
        jnp.maximum(progress.best_return, ended_returns.max()),
        progress.episodes + done.sum(),
        progress.env_steps + steps * environments,
        first,
        progress.diverged,
    )
    return after, jnp.where(ended > 0, reached / jnp.maximum(ended, 1), jnp.nan)


def watch(progress: Progress, params: Params) -> Progress:
    """Record when an expert's parameters stop being finite; it learns nothing afterwards."""
    finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(params)]).all()
    now = (progress.diverged == NEVER) & ~finite
    return progress._replace(diverged=jnp.where(now, progress.env_steps, progress.diverged))
