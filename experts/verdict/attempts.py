"""Attempts of an expert that is still training, for people to watch. They leave no trace in its training."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax.typing import VariableDict as Params
from jaxtyping import Array, Bool, Float, Key

from levelproof.experts.config import ExpertConfig
from levelproof.experts.policy import network_of
from levelproof.experts.training.rollout import ActionRule, rollout, start
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams


class Attempts(NamedTuple):
    """Poses of bodies after each env step, time first; they freeze when the attempt ends."""

    position: Float[Array, "time body 2 attempt"]  # m
    rotation: Float[Array, "time body attempt"]  # rad
    goal: Bool[Array, " attempt"]  # whether it reached the goal


@partial(jax.jit, static_argnames=("config", "rules", "count", "steps"))
def attempts(
    level: Level, params: Params, key: Key[Array, ""], config: ExpertConfig, rules: TaskParams, count: int, steps: int
) -> Attempts:
    """Play first episodes with sampled actions.

    Args:
        level: one level, level axis last.
        params: parameters of its expert.
        key: key of the sampled actions.
        config: settings of the expert.
        rules: the task's rules.
        count: number of attempts.
        steps: env steps of each attempt.
    """
    network, lanes = network_of(level.size, config), repeat(level, count)
    manner, no = ActionRule.sampling(count, 1), jnp.zeros(count, bool)
    params = jax.tree.map(lambda x: x[None], params)

    def act(carry, key):
        acting, ended, shown, reached = carry
        acting, trajectory, _ = rollout(network, params, level, acting, key[None], manner, 1, rules)
        state, over = acting.world.state, ended | trajectory.done[0, 0]
        # The rollout resets the world of an attempt that ends, so the poses before its last env step stay
        shown = jax.tree.map(lambda old, new: jnp.where(over, old, new), shown, (state.position, state.rotation))
        reached |= ~ended & trajectory.goal[0, 0]
        return (acting, over, shown, reached), shown

    first = start(lanes)
    state = first.world.state
    carry, (position, rotation) = jax.lax.scan(
        act, (first, no, (state.position, state.rotation), no), jax.random.split(key, steps)
    )
    return Attempts(position, rotation, carry[-1])
