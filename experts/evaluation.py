"""First episodes on many levels, played side by side by a policy for all levels or by an untrained player.

An attempt's random numbers depend on the level's id, the seed and the attempt's number, not on the lanes beside it, so
results do not depend on how levels are batched.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Key

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.networks.over_levels import NetworkConfig, policy_logits
from levelproof.experts.policy import most_probable, sample
from levelproof.levelgen.batching import block_size, blocks, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.fresh import renewed
from levelproof.levelgen.task.rules import StepResult, TaskParams, TaskState

LANES = 256  # that play side by side; measured on a CPU core
QUEUED = 32  # episodes of a batch for each lane; at a batch's end, lanes wait for its last episodes
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
    return evenly(moment.uniform)


def play_sticky(params: Any, moment: Moment) -> Int[Array, "6 lane"]:
    """Repeat each entry of the previous action with probability STAY; else, and at the start, draw it uniformly."""
    fresh = moment.now.timestep == 0
    left = jnp.where(fresh, moment.uniform, (moment.uniform - STAY) / (1 - STAY))
    return jnp.where(left >= 0, evenly(left), moment.previous)


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
        lanes: episodes that are played side by side, which bound the memory; they change no result.
    """
    rounds = -(-attempts // lanes)  # of each batch; more than 1 if a level has more attempts than `lanes`
    at_once = -(-attempts // rounds)
    count, program = len(level_ids), _program(player, at_once, rules, lanes)
    parts = []
    for some in blocks(count, block_size(count, max(1, QUEUED * lanes // at_once))):
        own = np.int32(some[-1] - some[0] + 1)  # without padding
        batch = take(levels, some), level_ids[some], own, np.uint32(seed)
        firsts = np.arange(rounds, dtype=np.uint32) * at_once
        played = [jax.device_get(program(params, *batch, first)) for first in firsts]
        parts.append([np.concatenate(column, 1)[:, :attempts] for column in zip(*played, strict=True)])
        follow(int(own))
    return FirstEpisodes(*(np.concatenate(column)[:count] for column in zip(*parts, strict=True)))


class FirstAttempts(NamedTuple):
    """The first attempt at each level."""

    action: Int8[np.ndarray, "256 6 level"]  # those after the end mean nothing
    env_steps: Int[np.ndarray, " level"]
    solved: Bool[np.ndarray, " level"]


def first_attempts(
    player: Player,
    params: Any,
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    seed: int,
    rules: TaskParams,
) -> FirstAttempts:
    """Return the first attempt that `play` makes at each level, with its actions.

    Arguments are those of `play`; all levels are played at once.
    """
    return jax.device_get(_recorder(player, rules)(params, levels, level_ids, np.uint32(seed)))


@lru_cache(maxsize=4)
def _recorder(player: Player, rules: TaskParams) -> Callable[..., FirstAttempts]:
    """Compile the first attempts at a batch of levels."""

    @jax.jit
    def run(params: Any, levels: Level, level_ids: Int[Array, " level"], seed: Array) -> Any:
        def act(before: Any, _: Any) -> tuple[Any, Array]:
            attempt, going, steps, solved = before
            attempt, result = _step(player, params, attempt, rules)
            after = attempt, going & ~result.done, steps + going, solved | (going & result.goal)
            return after, attempt.previous.astype(jnp.int8)

        none = jnp.zeros(len(level_ids), bool)
        begun = _begun(levels, _keys(level_ids, seed, jnp.arange(1))), ~none, none.astype(jnp.int32), none
        (_, _, steps, solved), action = jax.lax.scan(act, begun, length=RECORD_STEPS)
        return FirstAttempts(action, steps, solved)  # pyright: ignore

    return run


class _Attempt(NamedTuple):
    """An episode under way in each lane."""

    level: Level  # with its first state
    key: Key[Array, " lane"]
    now: TaskState
    previous: Int[Array, "6 lane"]


class _Queue(NamedTuple):
    """Lanes that take one episode of a batch after another, and the results of those that ended."""

    episode: Int[Array, " lane"]  # index of the lane's episode; the number of episodes: the lane has finished
    attempt: _Attempt
    coming: Int[Array, ""]  # number of the episode that starts next
    solved: Bool[Array, " episode"]
    env_steps: Int[Array, " episode"]


@lru_cache(maxsize=16)
def _program(player: Player, attempts: int, rules: TaskParams, lanes: int) -> Callable[..., FirstEpisodes]:
    """Compile the episodes of the first `own` levels of a batch; `first` is the number of their first attempt.

    A lane whose episode ends starts the next one of the batch: most episodes are short, and the longest last for
    RECORD_STEPS.
    """

    @jax.jit
    def run(
        params: Any, levels: Level, level_ids: Int[Array, " level"], own: Int[Array, ""], seed: Array, first: Array
    ) -> FirstEpisodes:
        room, count = len(level_ids) * attempts, own * attempts
        keys = _keys(level_ids, seed, first + jnp.arange(attempts))
        begin = lambda episode: _begun(jax.tree.map(lambda x: x[..., episode // attempts], levels), keys[episode])

        def advance(queue: _Queue) -> _Queue:
            attempt, result = _step(player, params, queue.attempt, rules)
            steps = attempt.now.timestep
            over = (queue.episode < count) & (result.done | (steps == RECORD_STEPS))
            ended = jnp.where(over, queue.episode, room)  # `room`: dropped
            rank = jnp.cumsum(over, dtype=jnp.int32)
            episode = jnp.where(over, jnp.minimum(queue.coming + rank - 1, count), queue.episode)
            return _Queue(
                episode,
                renewed(over & (episode < count), episode, begin, attempt),
                queue.coming + rank[-1],
                queue.solved.at[ended].set(result.goal, mode="drop"),
                queue.env_steps.at[ended].set(steps, mode="drop"),
            )

        width = min(lanes, room)
        at_first = jnp.arange(width, dtype=jnp.int32)
        results = jnp.zeros(room, bool), jnp.zeros(room, jnp.int32)
        queue = _Queue(at_first, begin(at_first), jnp.int32(width), *results)
        over = jax.lax.while_loop(lambda queue: (queue.episode < count).any(), advance, queue)
        shape = len(level_ids), attempts
        return FirstEpisodes(over.solved.reshape(shape), over.env_steps.reshape(shape))  # pyright: ignore

    return run


def _begun(level: Level, key: Key[Array, " lane"]) -> _Attempt:
    now = task.reset(level)
    return _Attempt(level, key, now, jnp.zeros((ACTIONS, len(now.timestep)), jnp.int32))


def _step(player: Player, params: Any, attempt: _Attempt, rules: TaskParams) -> tuple[_Attempt, StepResult]:
    """Take an env step in every lane, even if its episode has ended."""
    level, now = attempt.level, attempt.now
    draw = lambda key, step: jax.random.uniform(jax.random.fold_in(key, step), (ACTIONS,))
    uniform = jax.vmap(draw, out_axes=-1)(attempt.key, now.timestep)
    action = jnp.where(action_mask(level), player(params, Moment(level, now, attempt.previous, uniform)), 0)
    after, result = task.advance(level, now, action, rules)
    return attempt._replace(now=after, previous=action), result


def _keys(level_ids: Int[Array, " level"], seed: Array, attempts: Int[Array, " attempt"]) -> Key[Array, " lane"]:
    """Return each attempt's key; the attempts of a level are neighbours."""

    def of_level(level_id: Array) -> Key[Array, " attempt"]:
        key = jax.random.fold_in(key_for(level_id, Stream.POLICY), seed)
        return jax.vmap(partial(jax.random.fold_in, key))(attempts)

    return jax.vmap(of_level)(level_ids).reshape(-1)


def evenly(uniform: Float[Array, "6 lane"]) -> Int[Array, "6 lane"]:
    """Return each entry's choice for a random number in [0, 1), all choices equally likely."""
    choices = jnp.array(CHOICES)[:, None]
    return jnp.minimum((uniform * choices).astype(jnp.int32), choices - 1)


def _logits(params: Any, network: NetworkConfig, moment: Moment) -> Float[Array, "logit lane"]:
    return policy_logits(params, network, moment.level, moment.now.state)
