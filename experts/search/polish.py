"""Polishing: search around a witness for a shorter one, within a number of env steps.

In every round each lane plays a variation of the shortest success so far: a stretch of it is left out, held or
resampled. The shortest variation enters the next round; of equals the one that is nearest to the goal one step
earlier, because it can become a step shorter.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.play import CODES, Arena, Walk, arena, decode
from levelproof.experts.search.shorten import Shortened, below, drawn, edited, ended, replayed
from levelproof.experts.witness.success import Success
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import TaskParams, goal_distance

LANES = 16  # per level: few, so that there are many rounds


class Polishing(NamedTuple):
    """State of polishing, level first."""

    success: Success
    near: Float[Array, " level"]  # m, distance of green and blue one env step before the goal; infinity: unknown
    env_steps: Int[Array, " level"]  # of all lanes
    number: Int[Array, ""]  # of rounds done


@partial(jax.jit, static_argnames=("env_steps", "rules"))
def polish(
    levels: Level, level_ids: Int[Array, " level"], success: Success, env_steps: int, rules: TaskParams
) -> Shortened:
    """Search for shorter successes until every level has used its env steps, rounded up to whole rounds.

    Args:
        levels: the levels, lane axis last.
        level_ids: their ids, the seeds of all randomness.
        success: a success of each level that replays, level first; length 0: none, so no env step is made.
        env_steps: env steps per level, all lanes together.
        rules: the task's rules.
    """
    ring = arena(levels, LANES, (1.0,))
    keys = jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, Stream.SEARCH), 2))(level_ids)
    count = len(level_ids)
    level, live = jnp.arange(count), action_mask(levels).T

    def active(now: Polishing) -> Bool[Array, " level"]:
        return (now.success.length > 1) & (now.env_steps < env_steps)

    def one(now: Polishing) -> Polishing:
        best, goes = now.success, active(now)
        bits = jax.vmap(lambda key: jax.random.bits(jax.random.fold_in(key, now.number), (10, LANES)))(keys)
        action = jax.vmap(varied)(best.action, best.length, bits, live)
        length, near = neared(ring, action, jnp.where(goes, best.length, 0), rules)
        least = length == length.min(-1, keepdims=True)
        lane = jnp.argmin(jnp.where(least, near, jnp.inf), axis=-1)
        length, near = length[level, lane], near[level, lane]
        sooner = length < best.length
        better = goes & (sooner | ((length == best.length) & (near < now.near)))
        return Polishing(
            Success(
                jnp.where(better[:, None, None], action[level, lane], best.action),
                jnp.where(better, length, best.length),
            ),
            jnp.where(better, jnp.where(sooner, jnp.inf, near), now.near),
            now.env_steps + jnp.where(goes, LANES * best.length, 0),
            now.number + 1,
        )

    none = jnp.zeros(count, jnp.int32)
    start = Polishing(success, jnp.full(count, jnp.inf, jnp.float32), none, jnp.int32(0))
    end = jax.lax.while_loop(lambda now: active(now).any(), one, start)
    return Shortened(ended(*end.success), end.env_steps)


def varied(
    action: Int[Array, "256 6"], length: Int[Array, ""], bits: UInt32[Array, "10 lane"], live: Bool[Array, "6"]
) -> Int[Array, "lane 256 6"]:
    """Vary the actions for each lane: half resample a stretch, three quarters leave out or hold one.

    Only `live` entries, those that have an effect, are resampled.
    """
    edit = drawn(bits[:6], length)
    redraws, edits = bits[6] >> 31 == 1, (bits[6] >> 29) % 4 > 0
    edit = jax.tree.map(lambda x: jnp.where(edits | ~redraws, x, 0), edit)
    cut = edited(action, length, edit)
    first = below(bits[7], length)
    steps = jnp.maximum(length >> below(bits[8], jnp.int32(7)), 1)
    fresh = decode((bits[9] % CODES).astype(jnp.uint16)).T  # [lane, 6]
    which = ((bits[6][:, None] >> jnp.arange(ACTIONS, dtype=jnp.uint32)) & 1 == 1) & live
    step = jnp.arange(RECORD_STEPS)
    inside = (step >= first[:, None]) & (step < (first + steps)[:, None]) & redraws[:, None]
    return jnp.where(inside[:, :, None] & which[:, None], fresh[:, None], cut).astype(action.dtype)


def neared(
    ring: Arena, action: Int[Array, "level lane 256 6"], most: Int[Array, " level"], rules: TaskParams
) -> tuple[Int[Array, "level lane"], Float[Array, "level lane"]]:
    """Replay as `replayed`; also return the distance of green and blue, m, a step before `most`, if that is the end."""
    last = jnp.repeat(most, action.shape[1])

    def look(walk: Walk, near: Float[Array, " lane"]) -> Float[Array, " lane"]:
        return jnp.where(walk.timestep == last - 1, goal_distance(ring.lanes, walk.state), near)

    length, near = replayed(ring, action, most, rules, look, jnp.zeros(len(last)))
    return length, jnp.where(length == most[:, None], near.reshape(length.shape), 0.0)
