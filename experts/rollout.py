"""Experts acting in their levels: `levels x environments` lanes, level by level.

Lane `i * environments + j` is environment j of level i.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from experts.policy import ActorCritic, forward, log_probability, most_probable, sample
from levelgen import task
from levelgen.actions import CHOICES
from levelgen.level import Level
from levelgen.observe import level_features, state_features
from levelgen.task import TaskParams, TaskState


class Experience(NamedTuple):
    """What happened, time first."""

    moving: Float[Array, "time dynamic level environment"]  # the moving rows of the observation before the action
    action: Int[Array, "time 6 level environment"]
    log_probability: Float[Array, "time level environment"]
    value: Float[Array, "time level environment"]
    reward: Float[Array, "time level environment"]
    done: Bool[Array, "time level environment"]
    goal: Bool[Array, "time level environment"]


def repeat(level: Level, environments: int) -> Level:
    """Each level in as many neighbouring lanes."""
    return jax.tree.map(lambda x: jnp.repeat(x, environments, axis=-1), level)


def rollout(
    network: ActorCritic,
    params,
    levels: Level,
    world: TaskState,
    keys: Key[Array, " level"],
    greedy: Bool[Array, " environment"],
    steps: int,
    rules: TaskParams,
) -> tuple[TaskState, Experience, Float[Array, "level environment"]]:
    """Act for `steps` env steps, with automatic reset.

    Args:
        network: the shape of the experts' networks.
        params: of every expert, level axis first.
        levels: one per expert.
        world: episodes under way, one per lane.
        keys: one per expert, used up.
        greedy: environments that take the most probable action instead of a sampled one.
        steps: env steps in each lane.
        rules: of the task.

    Returns:
        The episodes afterwards, the experience, and the value of the last observation.
    """
    environments = len(greedy)
    level_count = keys.shape[0]
    lanes = repeat(levels, environments)
    constant = level_features(levels)
    per_level = lambda x: x.reshape(*x.shape[:-1], level_count, environments)
    each = jax.vmap(partial(forward, network), in_axes=(0, 1, 1), out_axes=(-2, 0))

    def look(world):
        moving = per_level(state_features(lanes, world.state))
        logits, value = each(params, constant, moving)
        return moving, logits, value

    def act(world, t):
        moving, logits, value = look(world)
        draw = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, t), (len(CHOICES), environments)))
        flat = lambda x: x.reshape(*x.shape[:-2], -1)
        logits, uniform = flat(logits), flat(jnp.moveaxis(draw(keys), 0, 1))
        action = jnp.where(jnp.tile(greedy, level_count), most_probable(logits), sample(logits, uniform))
        chance = log_probability(logits, action)
        world, outcome = task.step(lanes, world, action, rules)
        action, chance, reward, done, goal = map(per_level, (action, chance, *outcome))
        seen = Experience(moving, action, chance, value, reward, done, goal)
        return world, seen

    world, experience = jax.lax.scan(act, world, jnp.arange(steps))
    return world, experience, look(world)[2]
