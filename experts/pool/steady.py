"""Steadying: search around a witness for one that survives more replays from perturbed starts.

In every round many lanes play variations of the witness. The shortest of those that reach the goal, and the
witness itself, are replayed from perturbed starts; the one that survives most enters the next round, which draws
other starts.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.play import arena, fresh_walk
from levelproof.experts.search.polish import varied
from levelproof.experts.search.shorten import Shortened, replayed
from levelproof.experts.verdict.portability import moved, survivors
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import TaskParams

LANES = 64  # per level; the first plays the witness itself, the others variations
KEPT = 8  # successes per level that are replayed, the witness among them
STARTS = 32  # perturbed starts of each


class Steadying(NamedTuple):
    """State of steadying, level first."""

    success: Success
    steady: Bool[Array, " level"]  # the success has survived all replays of a round
    env_steps: Int[Array, " level"]  # of all lanes
    number: Int[Array, ""]  # of rounds done


@partial(jax.jit, static_argnames=("rounds", "rules"))
def steady(
    levels: Level, level_ids: Int[Array, " level"], success: Success, rounds: int, rules: TaskParams
) -> Shortened:
    """Vary every success until one has survived all replays of a round.

    Args:
        levels: the levels, lane axis last.
        level_ids: their ids, the seeds of all randomness.
        success: a success of each level that replays, level first.
        rounds: maximum number of rounds.
        rules: the task's rules.
    """
    count = len(level_ids)
    level, lane, step = jnp.arange(count), jnp.arange(LANES), jnp.arange(RECORD_STEPS)
    live = action_mask(levels).T
    ring, crowd = arena(levels, LANES, (1.0,)), arena(levels, KEPT * STARTS, (1.0,))
    few = repeat(levels, STARTS)
    keys = jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, Stream.SEARCH), 3))(level_ids)

    def one(now: Steadying) -> Steadying:
        best, goes = now.success, ~now.steady
        bits = jax.vmap(lambda key: jax.random.bits(jax.random.fold_in(key, now.number), (10, LANES)))(keys)
        action = jax.vmap(varied)(best.action, best.length, bits, live).at[:, 0].set(best.action)
        length, _ = replayed(ring, action, jnp.where(goes, best.length, 0), rules)
        kept = jnp.argsort(jnp.where(lane, length * LANES + lane, 0), axis=-1)[:, :KEPT]
        action, length = action[level[:, None], kept], length[level[:, None], kept]
        reached = length <= RECORD_STEPS

        state = moved(few, level_ids, STARTS, now.number + 1)
        spread = lambda x: jnp.repeat(x.reshape(*x.shape[:-1], count, 1, STARTS), KEPT, -2).reshape(*x.shape[:-1], -1)
        start = fresh_walk(crowd.lanes)._replace(state=jax.tree.map(spread, state))
        again = jnp.where(step < length[:, :, None], step, step - length[:, :, None])
        whole = jnp.take_along_axis(action, jnp.clip(again, 0, RECORD_STEPS - 1)[..., None], axis=2)
        by_lane = jnp.repeat(jnp.moveaxis(whole.reshape(count * KEPT, *whole.shape[2:]), 0, -1), STARTS, -1)
        steps = jnp.repeat(jnp.where(reached & goes[:, None], length, 0).reshape(-1), STARTS)
        survived = survivors(crowd, start, by_lane, steps, rules).reshape(count, KEPT, STARTS).sum(-1)
        survived = jnp.where(reached, survived, -1)
        first = jnp.argmax(survived, axis=-1)
        take = goes & reached[level, first]
        return Steadying(
            Success(
                jnp.where(take[:, None, None], action[level, first], best.action),
                jnp.where(take, length[level, first], best.length),
            ),
            now.steady | (take & (survived[level, first] == STARTS)),
            now.env_steps + jnp.where(goes, (LANES + KEPT * STARTS) * best.length, 0),
            now.number + 1,
        )

    none = jnp.zeros(count, jnp.int32)
    going = lambda now: (now.number < rounds) & ~now.steady.all()
    end = jax.lax.while_loop(going, one, Steadying(success, success.length == 0, none, jnp.int32(0)))
    return Shortened(end.success, end.env_steps)
