"""First episodes on many levels side by side: of a policy for all levels, and of players that learned nothing.

An attempt's random numbers depend on the level's id, the seed and the attempt's number, not on the lanes beside it, so
results do not depend on how levels are batched.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.networks.over_levels import NetworkConfig, policy_logits
from levelproof.experts.policy import most_probable, sample
from levelproof.levelgen.batching import block_size, blocks, repeat, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.rules import TaskParams, TaskState

LANES = 1024  # of a batch
PART = 16  # env steps between checks whether all attempts have ended
STAY = 0.9  # chance that sticky random play repeats an entry of the previous action


class Moment(NamedTuple):
    """What a player may know when it acts, lanes last."""

    level: Level
    now: TaskState
    previous: Int[Array, "6 lane"]  # the action before; zeros at the start
    uniform: Float[Array, "6 lane"]  # random numbers in [0, 1), one for each entry


Player = Callable[[Any, Moment], Int[Array, "6 lane"]]  # from parameters and a moment to actions


class FirstEpisodes(NamedTuple):
    """First episodes, from the levels' start."""

    solved: Bool[np.ndarray, "level attempt"]
    env_steps: Int[np.ndarray, "level attempt"]  # until the episode's end


def do_nothing(params: Any, moment: Moment) -> Int[Array, "6 lane"]:
    """Use no actuator."""
    return jnp.zeros_like(moment.previous)


def play_randomly(params: Any, moment: Moment) -> Int[Array, "6 lane"]:
    """Draw every entry uniformly."""
    return _evenly(moment.uniform)


def play_sticky(params: Any, moment: Moment) -> Int[Array, "6 lane"]:
    """Repeat each entry of the previous action with probability STAY; else, and at the start, draw it uniformly."""
    fresh = moment.now.timestep == 0
    left = jnp.where(fresh, moment.uniform, (moment.uniform - STAY) / (1 - STAY))
    return jnp.where(left >= 0, _evenly(left), moment.previous)


@lru_cache(maxsize=16)
def play_sampled(network: NetworkConfig) -> Player:
    """Return the player that samples from a policy's logits; its parameters are the policy's."""
    return lambda params, moment: sample(_logits(params, network, moment), moment.uniform)


@lru_cache(maxsize=16)
def play_most_probable(network: NetworkConfig) -> Player:
    """Return the player that takes a policy's most probable choices; its parameters are the policy's."""
    return lambda params, moment: most_probable(_logits(params, network, moment))


def play(
    player: Player,
    params: Any,
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    attempts: int,
    seed: int,
    rules: TaskParams,
    follow: Callable[[int], None] = lambda _: None,
    lanes: int = LANES,
) -> FirstEpisodes:
    """Play `attempts` episodes of each level, each of at most RECORD_STEPS env steps.

    Args:
        player: chooses actions; a static argument, so pass the same function again.
        params: the player's parameters.
        levels: the levels, on the host, level axis last.
        level_ids: their ids; with the seed and the attempt's number, they decide all randomness.
        attempts: episodes of a level.
        seed: 0 or more.
        rules: the task's rules.
        follow: called after every batch with its number of levels.
        lanes: episodes of a batch, which bound its memory; they change no result.
    """
    rounds = -(-attempts // lanes)  # of each batch; more than 1 if a level has more attempts than `lanes`
    at_once = -(-attempts // rounds)
    count, program = len(level_ids), _program(player, at_once, rules)
    parts = []
    for some in blocks(count, block_size(count, max(1, lanes // at_once))):
        batch, firsts = (take(levels, some), level_ids[some], np.uint32(seed)), np.arange(rounds, dtype=np.uint32)
        played = [jax.device_get(program(params, *batch, first)) for first in firsts * at_once]
        parts.append([np.concatenate(column, 1)[:, :attempts] for column in zip(*played, strict=True)])
        follow(len(np.unique(some)))
    return FirstEpisodes(*(np.concatenate(column)[:count] for column in zip(*parts, strict=True)))


def first_actions(
    player: Player,
    params: Any,
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    seed: int,
    rules: TaskParams,
) -> Int[np.ndarray, "256 6 level"]:
    """Return the actions that `play` takes in the first attempt at each level; those after its end mean nothing.

    Arguments are those of `play`; all levels are played at once.
    """
    return np.asarray(_recorder(player, rules)(params, levels, level_ids, np.uint32(seed)))


@lru_cache(maxsize=4)
def _recorder(player: Player, rules: TaskParams) -> Callable[..., Int[Array, "256 6 level"]]:
    """Compile the first attempts at a batch of levels."""

    @jax.jit
    def run(params: Any, levels: Level, level_ids: Int[Array, " level"], seed: Array) -> Int[Array, "256 6 level"]:
        keys = _keys(level_ids, seed, jnp.arange(1))
        step = partial(_step, player, params, levels, action_mask(levels), keys, rules)
        return jax.lax.scan(step, _begun(levels), jnp.arange(RECORD_STEPS))[1]

    return run


class _Playing(NamedTuple):
    now: TaskState
    previous: Int[Array, "6 lane"]
    ended: Bool[Array, " lane"]
    solved: Bool[Array, " lane"]
    env_steps: Int[Array, " lane"]


@lru_cache(maxsize=16)
def _program(player: Player, attempts: int, rules: TaskParams) -> Callable[..., FirstEpisodes]:
    """Compile the episodes of a batch of levels; `first` is the number of their first attempt."""

    @jax.jit
    def run(params: Any, levels: Level, level_ids: Int[Array, " level"], seed: Array, first: Array) -> FirstEpisodes:
        shape = len(level_ids), attempts
        keys, level = _keys(level_ids, seed, first + jnp.arange(attempts)), repeat(levels, attempts)
        step = partial(_step, player, params, level, action_mask(level), keys, rules)

        def advance(carry: tuple[Array, _Playing]) -> tuple[Array, _Playing]:
            first, playing = carry
            return first + PART, jax.lax.scan(step, playing, first + jnp.arange(PART))[0]

        going = lambda carry: (carry[0] < RECORD_STEPS) & ~carry[1].ended.all()
        _, after = jax.lax.while_loop(going, advance, (jnp.int32(0), _begun(level)))
        return FirstEpisodes(after.solved.reshape(shape), after.env_steps.reshape(shape))  # pyright: ignore

    return run


def _begun(level: Level) -> _Playing:
    no = jnp.zeros(len(level), bool)
    return _Playing(task.reset(level), jnp.zeros((ACTIONS, no.size), jnp.int32), no, no, no.astype(jnp.int32))


def _step(
    player: Player,
    params: Any,
    level: Level,
    live: Bool[Array, "6 lane"],
    keys: Key[Array, " lane"],
    rules: TaskParams,
    playing: _Playing,
    number: Int[Array, ""],
) -> tuple[_Playing, Int[Array, "6 lane"]]:
    """Take env step `number` in every lane; lanes that have ended continue, but no longer count.

    Returns the next state of play, and the actions.
    """
    draw = lambda key: jax.random.uniform(jax.random.fold_in(key, number), (ACTIONS,))
    moment = Moment(level, playing.now, playing.previous, jax.vmap(draw, out_axes=-1)(keys))
    action = jnp.where(live, player(params, moment), 0)
    now, result = task.advance(level, playing.now, action, rules)
    after = _Playing(
        now,
        action,
        playing.ended | result.done,
        playing.solved | (~playing.ended & result.goal),
        playing.env_steps + ~playing.ended,
    )
    return after, action


def _keys(level_ids: Int[Array, " level"], seed: Array, attempts: Int[Array, " attempt"]) -> Key[Array, " lane"]:
    """Return each attempt's key; the attempts of a level are neighbours."""

    def of_level(level_id: Array) -> Key[Array, " attempt"]:
        key = jax.random.fold_in(key_for(level_id, Stream.POLICY), seed)
        return jax.vmap(partial(jax.random.fold_in, key))(attempts)

    return jax.vmap(of_level)(level_ids).reshape(-1)


def _evenly(uniform: Float[Array, "6 lane"]) -> Int[Array, "6 lane"]:
    choices = jnp.array(CHOICES)[:, None]
    return jnp.minimum((uniform * choices).astype(jnp.int32), choices - 1)


def _logits(params: Any, network: NetworkConfig, moment: Moment) -> Float[Array, "logit lane"]:
    return policy_logits(params, network, moment.level, moment.now.state)
