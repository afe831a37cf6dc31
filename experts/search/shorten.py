"""Shortening of a success: leave out or hold stretches of it, and keep what reaches the goal sooner."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.play import Arena, Walk, act, arena, fresh_walk
from levelproof.experts.witness.success import Success
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task.rules import TaskParams

MAX_HALVINGS = 6  # stretches range from a whole success to a 64th of it
T = TypeVar("T")


class Shortened(NamedTuple):
    """Shortened successes, level first."""

    success: Success  # length 0: the given success does not reach the goal
    env_steps: Int[Array, " level"]  # of all lanes


class Edit(NamedTuple):
    """A stretch to leave out, then one that holds its first action; each by its first step and length."""

    left_out: Int[Array, " lane"]
    left_out_steps: Int[Array, " lane"]
    held: Int[Array, " lane"]
    held_steps: Int[Array, " lane"]


@partial(jax.jit, static_argnames=("config", "rules"))
def shorten(
    levels: Level, level_ids: Int[Array, " level"], success: Success, config: SearchConfig, rules: TaskParams
) -> Shortened:
    """Try `config.trials` rounds of edits, one per lane; each round edits the shortest success so far.

    In the first round, one lane plays the unchanged success.

    Args:
        levels: the levels, lane axis last.
        level_ids: their ids, the seeds of all randomness.
        success: a success of each level, level first; length 0: none.
        config: its settings give lanes and rounds.
        rules: the task's rules.
    """
    ring = arena(levels, config.lanes, config.redrawn)
    keys = jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, Stream.SEARCH), 1))(level_ids)
    count = len(level_ids)

    def trial(number: Int[Array, ""], so_far: tuple[Success, Array]) -> tuple[Success, Array]:
        best, env_steps = so_far
        bits = jax.vmap(lambda key: jax.random.bits(jax.random.fold_in(key, number), (6, config.lanes)))(keys)
        edits = jax.vmap(drawn)(bits, best.length)
        nothing = (number == 0) & (jnp.arange(config.lanes) == 0)
        edits = jax.tree.map(lambda x: jnp.where(nothing, 0, x), edits)
        action = jax.vmap(edited)(best.action, best.length, edits)
        length, _ = replayed(ring, action, best.length, rules)
        lane = jnp.argmin(length, axis=-1)
        level = jnp.arange(count)
        shorter = (length[level, lane] < best.length) | (number == 0)
        kept = jnp.where(shorter[:, None, None], action[level, lane], best.action)
        steps = jnp.where(shorter, length[level, lane], best.length)
        return Success(kept, steps), env_steps + config.lanes * best.length

    best, env_steps = jax.lax.fori_loop(0, config.trials, trial, (success, jnp.zeros(count, jnp.int32)))
    return Shortened(ended(best.action, jnp.where(best.length > RECORD_STEPS, 0, best.length)), env_steps)


def ended(action: Int[Array, "level 256 6"], length: Int[Array, " level"]) -> Success:
    """Return successes of these lengths, with zeros after the end."""
    inside = jnp.arange(RECORD_STEPS) < length[:, None]
    return Success(jnp.where(inside[:, :, None], action, 0), length)


def below(bits: UInt32[Array, " lane"], bound: Int[Array, "*lane"]) -> Int[Array, " lane"]:
    """Map random bits to integers below a bound; 0 if the bound is 0."""
    return (bits % jnp.maximum(bound, 1).astype(jnp.uint32)).astype(jnp.int32)


def drawn(bits: UInt32[Array, "6 lane"], length: Int[Array, ""]) -> Edit:
    """Draw random edits: a quarter leave out the beginning, half hold nothing."""
    stretch = lambda bits: jnp.maximum(length >> below(bits, jnp.int32(MAX_HALVINGS + 1)), 1)
    first = jnp.where(bits[0] >> 30 == 0, 0, below(bits[1], length))
    holds = bits[0] >> 31 == 1
    return Edit(first, stretch(bits[2]), below(bits[3], length), jnp.where(holds, stretch(bits[4]), 0))


def edited(action: Int[Array, "256 6"], length: Int[Array, ""], edit: Edit) -> Int[Array, "lane 256 6"]:
    """Apply an edit per lane; the last action is repeated to the end."""
    step = jnp.arange(RECORD_STEPS)
    at = lambda x: x[:, None]
    step = jnp.where((step >= at(edit.held)) & (step < at(edit.held + edit.held_steps)), at(edit.held), step)
    step = jnp.where(step >= at(edit.left_out), step + at(edit.left_out_steps), step)
    return action[jnp.minimum(step, jnp.maximum(length - 1, 0))]


def replayed(
    ring: Arena,
    action: Int[Array, "level lane 256 6"],
    most: Int[Array, " level"],
    rules: TaskParams,
    look: Callable[[Walk, T], T] = lambda _, seen: seen,
    seen: T = None,
) -> tuple[Int[Array, "level lane"], T]:
    """Return env steps from the level's start to the goal; RECORD_STEPS + 1 if it is not reached within `most`.

    After each env step, `look` folds the walk into `seen`, which is returned as well.
    """
    count, lanes = action.shape[:2]
    by_step = jnp.moveaxis(action.reshape(count * lanes, RECORD_STEPS, ACTIONS), 0, -1).astype(jnp.int32)

    def step(now: tuple[Walk, T]) -> tuple[Walk, T]:
        walk = act(ring, now[0], by_step[now[0].timestep[0]], rules)
        return walk, look(walk, now[1])

    going = lambda now: (now[0].timestep[0] < most.max()) & ~now[0].ended.all()
    walk, seen = jax.lax.while_loop(going, step, (fresh_walk(ring.lanes), seen))
    reached = walk.reached.reshape(count, lanes)
    return jnp.where((reached > 0) & (reached <= most[:, None]), reached, RECORD_STEPS + 1), seen
