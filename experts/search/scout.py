"""Scouts: persistent random play of a level's first episodes, at the speed of bare physics, before any expert.

A success that is found so is the first that the level's expert rehearses, and a witness where its expert finds none.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key

from levelproof.experts.config import RECORD_STEPS, ScoutConfig
from levelproof.experts.witness.success import Success, ending_at, no_success
from levelproof.levelgen.batching import at_once, blocks, repeat, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.rules import TaskParams

EPISODES = 64  # lanes of a level
STEPS_PER_ROUND = EPISODES * RECORD_STEPS
REDRAWN = (0.02, 0.05, 0.1, 0.3)  # chance that an entry of the action is drawn anew; of a quarter of the lanes each
IN_CACHE = 256  # lanes: their physics fits the cache of a core


class Scouted(NamedTuple):
    """What scouts found, on the host, level first."""

    success: Success  # the shortest
    env_steps: Int[np.ndarray, " level"]


def scout(levels: Level, level_ids: Int[np.ndarray, " level"], config: ScoutConfig, rules: TaskParams) -> Scouted:
    """Play every level in rounds of 64 lanes and 256 env steps, until a round has a success or there was the last.

    Args:
        levels: on the host.
        level_ids: their ids, the seeds of all randomness.
        config: how many rounds.
        rules: of the task.
    """
    count = len(level_ids)
    action, length = no_success(count)
    env_steps = np.zeros(count, np.int64)
    for number in range(config.rounds):
        left = np.flatnonzero(length == 0)
        env_steps[left] += STEPS_PER_ROUND
        for block in blocks(len(left), at_once(EPISODES, IN_CACHE)):
            some = left[block]
            found = play(take(levels, some), level_ids[some], np.int32(number), rules)
            action[some], length[some] = jax.device_get(found)
    return Scouted(Success(action, length), env_steps)


@partial(jax.jit, static_argnames="rules")
def play(levels: Level, level_ids: Int[Array, " level"], number: Int[Array, ""], rules: TaskParams) -> Success:
    """The shortest success of each level's round with this number, level first."""
    count, lanes = len(level_ids), repeat(levels, EPISODES)
    live = action_mask(lanes)
    keys = jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, Stream.SCOUT), number))(level_ids)
    redrawn = jnp.tile(jnp.repeat(jnp.array(REDRAWN), EPISODES // len(REDRAWN)), count)

    def act(carry, t):
        now, last = carry
        action = jnp.where(live, persistent(last, draw(keys, t), redrawn, now.timestep == 0), 0)
        after, outcome = task.step(lanes, now, action, rules)
        return (after, action), (action.astype(jnp.int8), outcome.goal, now.timestep)

    start = task.reset(lanes), jnp.zeros((len(CHOICES), count * EPISODES), jnp.int32)
    action, goal, timestep = jax.lax.scan(act, start, jnp.arange(RECORD_STEPS))[1]
    by_level = lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], count, EPISODES), -2, 0)
    return jax.vmap(shortest)(by_level(action), by_level(goal), by_level(timestep))


def draw(keys: Key[Array, " level"], t: Int[Array, ""]) -> Int[Array, "6 lane"]:
    """Random bits of one env step of EPISODES lanes of every level."""
    bits = lambda key: jax.random.bits(jax.random.fold_in(key, t), (len(CHOICES), EPISODES), jnp.uint32)
    return jnp.moveaxis(jax.vmap(bits)(keys), 0, 1).reshape(len(CHOICES), -1)


def persistent(
    last: Int[Array, "6 lane"], bits: Int[Array, "6 lane"], redrawn: Array, fresh: Bool[Array, " lane"]
) -> Int[Array, "6 lane"]:
    """The last action, some of its entries drawn anew: the upper 16 bits decide whether, the lower 16 which choice.

    Args:
        last: the action before.
        bits: random.
        redrawn: chance of each lane.
        fresh: lanes where all entries are drawn, as at an episode's start.
    """
    choices = jnp.array(CHOICES, jnp.uint32)[:, None]
    drawn = ((bits & 0xFFFF) * choices >> 16).astype(jnp.int32)
    return jnp.where(((bits >> 16) < (redrawn * 2**16).astype(jnp.uint32)) | fresh, drawn, last)


def shortest(
    action: Int[Array, "256 6 lane"], goal: Bool[Array, "256 lane"], timestep: Int[Array, "256 lane"]
) -> Success:
    """Of one level's lanes the shortest success, the first of several; `timestep` are env steps before each step."""
    length = jnp.where(goal, timestep + 1, RECORD_STEPS + 1)
    time, lane = jnp.divmod(jnp.argmin(length.reshape(-1)), length.shape[1])
    steps = jnp.where(goal.any(), length[time, lane], 0)
    return ending_at(action, time, lane, steps)
