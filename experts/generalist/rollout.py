"""Rollouts of one policy in lanes, each of which starts another level when its episode ends."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.generalist.actor_critic import ActorCriticParams, logits_and_value
from levelproof.experts.networks.chunks import chunk_by_chunk, lanes_at_once
from levelproof.experts.networks.over_levels import NetworkConfig, seen
from levelproof.experts.policy import log_probability, sample
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.sampling.sampler import Sampler, sampler
from levelproof.levelgen.task import environment
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.environment import EnvParams
from levelproof.levelgen.task.lanes import Lanes, LaneState, LevelTable, Table
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Size

Draw = Callable[[Key[Array, ""], int], Int[Array, " lane"]]  # from a key and a number of lanes to indices of levels


class Playing(NamedTuple):
    """Episodes under way, lanes last."""

    state: LaneState
    played: LevelTable  # each lane's level
    gained: Float[Array, " lane"]  # reward so far
    expected: Float[Array, " lane"]  # sum over the states so far of the reward until then plus the value


class Ended(NamedTuple):
    """Each lane's episode after every step: its final values where `done`, else its values so far."""

    done: Bool[Array, "time lane"]
    goal: Bool[Array, "time lane"]
    steps: Int[Array, "time lane"]
    gained: Float[Array, "time lane"]  # reward
    expected: Float[Array, "time lane"]  # sum over their states of the reward until then plus the value
    level_index: Int[Array, "time lane"]


class Experience(NamedTuple):
    """Data of a rollout, time first, lanes last."""

    seen: Any
    live: Bool[Array, "time 6 lane"]
    action: Int[Array, "time 6 lane"]
    log_probability: Float[Array, "time lane"]
    value: Float[Array, "time lane"]
    reward: Float[Array, "time lane"]
    done: Bool[Array, "time lane"]
    terminated: Bool[Array, "time lane"]  # by the task, not by the time limit alone


def lanes_of(size: Size, rules: TaskParams) -> Lanes:
    """Return the environment in lanes, for levels of any table."""
    unused = ObservationType.SYMBOLIC_ENTITY  # never computed: networks derive their own inputs
    return Lanes(environment.make(sampler(size), observation_type=unused, rules=rules)[0])


def table_of(levels: Level | Sampler, rules: TaskParams) -> Table:
    """Return the table from which lanes copy their levels; a sampler is its own table."""
    return lanes_of(levels.size, rules).table(EnvParams(levels))


def begin(table: Table, level_index: Int[Array, " lane"], rules: TaskParams) -> Playing:
    """Start an episode of these levels in every lane."""
    _, state, played = lanes_of(table.size, rules).reset(table, level_index)
    nothing = jnp.zeros(level_index.shape)
    return Playing(state, played, nothing, nothing)


def rollout(
    params: ActorCriticParams,
    network: NetworkConfig,
    table: Table,
    playing: Playing,
    draw: Draw,
    key: Key[Array, ""],
    steps: int,
    rules: TaskParams,
) -> tuple[Playing, Experience, Ended]:
    """Take `steps` actions in every lane, each as long as `rules` say.

    Args:
        params: the policy and its value function.
        network: the network's shape.
        table: all levels.
        playing: episodes under way.
        draw: chooses the level that each lane plays next, if its episode ends.
        key: consumed.
        steps: actions in each lane.
        rules: the task's rules, with the reward that is learned from.

    Returns:
        The episodes under way, the experience, and the episodes that ended.
    """
    size = table.size
    lanes = lanes_of(size, rules)
    count = playing.gained.shape[-1]
    at_once = lanes_at_once(size, count)

    def act(now: Playing, t: Array) -> tuple[Playing, tuple[Experience, Ended]]:
        of_action, of_level = jax.random.split(jax.random.fold_in(key, t))
        world = now.state.now.state
        observation = seen(network, replace(now.played.level, state=world), world)
        logits, value = chunk_by_chunk(partial(logits_and_value, params, network, size), observation, at_once)
        live = action_mask(now.played.level)
        action = jnp.where(live, sample(logits, jax.random.uniform(of_action, (ACTIONS, count))), 0)
        log_before = log_probability(logits, action, live)
        _, state, played, reward, done, info = lanes.step(table, now.played, now.state, action, draw(of_level, count))
        gained, expected = now.gained + reward, now.expected + now.gained + value
        ended = Ended(done, info["GoalR"], now.state.now.timestep + 1, gained, expected, info["level_index"])
        sample_of_step = Experience(observation, live, action, log_before, value, reward, done, info["terminated"])
        left = (jnp.where(done, 0.0, total) for total in (gained, expected))
        return Playing(state, played, *left), (sample_of_step, ended)

    after, (experience, ended) = jax.lax.scan(act, playing, jnp.arange(steps))
    return after, experience, ended
