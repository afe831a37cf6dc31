"""Attempts from any state: side by side, by a player, until one reaches the goal from there.

All attempts from a state start in exactly that state, impulses included, and have the env steps that its episode has
left. Players besides those of `experts.evaluation`: experts of single levels, and variations of witnesses.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Key

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.evaluation import Moment, Player, evenly
from levelproof.experts.policy import Params, forward, network_of, sample
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.rules import TaskParams, TaskState

MAX_SHIFT = 16  # env steps by which a variation of a witness may run ahead or behind
MAX_NOISE = 0.2  # largest probability that a variation of a witness draws an entry evenly


class Found(NamedTuple):
    """The shortest of a teacher's attempts from each state that reached the goal."""

    action: Int8[Array | np.ndarray, "256 6 state"]  # from the state on; meaningless after `length`
    length: Int[Array | np.ndarray, " state"]  # env steps; 0: none reached the goal


class Recalled(NamedTuple):
    """A witness to vary, in equally many lanes per state."""

    action: Int8[Array, "256 6 state"]
    shift: Int[Array, " lane"]  # env steps by which the lane runs ahead
    noise: Float[Array, " lane"]  # probability that an entry is drawn evenly


class _Trying(NamedTuple):
    """Attempts under way; `best` is the first attempt of each state that reached the goal."""

    step: Int[Array, ""]
    now: TaskState
    previous: Int[Array, "6 lane"]
    ended: Bool[Array, " lane"]
    best: Int[Array, " state"]
    length: Int[Array, " state"]
    action: Int8[Array, "256 6 lane"]
    env_steps: Int[Array, " state"]


@lru_cache(maxsize=4)
def play_expert(config: ExpertConfig) -> Player:
    """Return the player that samples from experts of single levels; its parameters are one expert's per state."""

    def act(params: Params, moment: Moment) -> Int[Array, "6 lane"]:
        network = network_of(moment.level.size, config)
        lanes, states = moment.uniform.shape[-1], len(jax.tree.leaves(params)[0])
        constant = network.constant(jax.tree.map(lambda x: x[..., :: lanes // states], moment.level))
        moving = state_features(moment.level, moment.now.state).reshape(-1, states, lanes // states)
        logits = lambda *one: forward(network, *one)[0]
        each = jax.vmap(logits, in_axes=(0, -1, 1), out_axes=1)(params, constant, moving)
        return sample(each.reshape(-1, lanes), moment.uniform)

    return act


def play_varied(params: Recalled, moment: Moment) -> Int[Array, "6 lane"]:
    """Take the witness's action at the episode's env step, shifted by `shift`; draw entries evenly with `noise`."""
    lanes, states = moment.uniform.shape[-1], params.action.shape[-1]
    step = jnp.clip(moment.now.timestep + params.shift, 0, RECORD_STEPS - 1)
    recalled = params.action[step, :, jnp.arange(lanes) // (lanes // states)].T.astype(jnp.int32)
    drawn = evenly(moment.uniform / jnp.maximum(params.noise, jnp.finfo(jnp.float32).tiny))
    return jnp.where(moment.uniform < params.noise, drawn, recalled)


def recalled(witness: Int8[Array | np.ndarray, "256 6 state"], attempts: int) -> Recalled:
    """Return variations of witnesses: the first is unchanged, later ones are increasingly noisy, some shifted."""
    number = np.tile(np.arange(attempts), witness.shape[-1])
    spread = (number // 2 * 7) % (2 * MAX_SHIFT + 1) - MAX_SHIFT
    shift = np.where(number % 2, spread, 0)
    noise = MAX_NOISE * number / attempts
    return Recalled(witness, shift.astype(np.int32), noise.astype(np.float32))  # pyright: ignore[reportArgumentType]


@partial(jax.jit, static_argnames=("player", "attempts", "rules"))
def attempt_from(
    player: Player, params: Any, level: Level, now: TaskState, keys: Key[Array, " state"], attempts: int,
    rules: TaskParams,
) -> tuple[Found, Int[Array, " state"]]:  # fmt: skip
    """Play `attempts` continuations of each state, until one reaches the goal or the episode runs out of env steps.

    Args:
        player: chooses actions.
        params: the player's parameters.
        level: the level of each state.
        now: the states.
        keys: one per state; consumed.
        attempts: lanes of a state, which are neighbours.
        rules: the task's rules.

    Returns:
        The shortest success from each state, and the env steps of its attempts.
    """
    states = len(keys)
    level, now = repeat((level, now), attempts)
    live, none = action_mask(level), jnp.zeros(states, jnp.int32)
    lanes = states * attempts
    by_state = lambda x: x.reshape(states, attempts)

    def uniform(number: Array) -> Float[Array, "6 lane"]:
        draw = lambda key: jax.random.uniform(jax.random.fold_in(key, number), (ACTIONS, attempts))
        return jax.vmap(draw, out_axes=1)(keys).reshape(ACTIONS, lanes)

    def act(trying: _Trying) -> _Trying:
        moment = Moment(level, trying.now, trying.previous, uniform(trying.step))
        action = jnp.where(live, player(params, moment), 0)
        after, result = task.advance(level, trying.now, action, rules)
        goal = by_state(result.goal & ~trying.ended)
        first = goal.any(1) & (trying.length == 0)
        over = result.done | (after.timestep >= RECORD_STEPS) | jnp.repeat(first, attempts)
        return _Trying(
            trying.step + 1,
            after,
            action,
            trying.ended | over,
            jnp.where(first, jnp.argmax(goal, 1), trying.best),
            jnp.where(first, trying.step + 1, trying.length),
            jax.lax.dynamic_update_index_in_dim(trying.action, action.astype(jnp.int8), trying.step, 0),
            trying.env_steps + by_state(~trying.ended).sum(1),
        )

    taken = jnp.zeros((RECORD_STEPS, ACTIONS, lanes), jnp.int8)
    previous = jnp.where(live, evenly(uniform(jnp.int32(RECORD_STEPS))), 0)  # for sticky play: drawn, not the learner's
    begun = _Trying(jnp.int32(0), now, previous, now.timestep >= RECORD_STEPS, none, none, taken, none)
    end = jax.lax.while_loop(lambda trying: ~trying.ended.all() & (trying.step < RECORD_STEPS), act, begun)
    best = jnp.arange(states) * attempts + end.best
    return Found(end.action[..., best], end.length), end.env_steps
