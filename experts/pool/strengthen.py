"""Strengthening: search around a witness for one that survives more replays from perturbed starts.

In every round many lanes play variations of the witness. The shortest of those that reach the goal, and the
witness itself, are replayed from perturbed starts; the one that survives most replays enters the next round, which
draws new starts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt16

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.edit import Draws, draw, edits, variation
from levelproof.experts.search.play import arena, best_lane, code_of, decode, fresh_walk, success_of
from levelproof.experts.search.shorten import Shortened, replayed
from levelproof.experts.verdict.portability import LATE, moved, survivors
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.rules import TaskParams

LANES = 64  # per level; the first plays the witness itself, the others variations
KEPT = 8  # successes per level that are replayed, the witness among them
STARTS = 32  # perturbed starts of each


class Strengthening(NamedTuple):
    """State of strengthening, level first."""

    code: UInt16[Array, "level step"]  # codes of the success's actions
    length: Int[Array, " level"]  # of the success, env steps
    robust: Bool[Array, " level"]  # the witness has survived all replays of a round
    env_steps: Int[Array, " level"]  # of all lanes
    number: Int[Array, ""]  # of rounds done


@jit_sooner(static_argnames=("rounds", "rules"))
def strengthen(
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
    count, lane = len(level_ids), jnp.arange(LANES)
    ring, crowd = arena(levels, LANES, (1.0,)), arena(levels, KEPT * STARTS, (1.0,))
    few = repeat(levels, STARTS)

    def one(now: Strengthening) -> Strengthening:
        active = ~now.robust
        new = edits(variation, now.code, now.length, draw(Draws.STRENGTHEN, level_ids, now.number, 10, LANES), ring)
        new = new.at[:, 0].set(now.code)
        steps, _ = replayed(ring, new, jnp.where(active, now.length, 0), rules, KEPT)
        # The witness is known to reach the goal, but is not played to its end if KEPT variations are shorter
        steps = steps.at[:, 0].set(jnp.where(active, now.length, RECORD_STEPS + 1))
        kept = jnp.argsort(jnp.where(lane, steps * LANES + lane, 0), axis=-1)[:, :KEPT]
        new, steps = jnp.take_along_axis(new, kept[..., None], 1), jnp.take_along_axis(steps, kept, 1)
        reached = steps <= RECORD_STEPS

        state = moved(few, level_ids, STARTS, now.number + 1)
        spread = lambda x: jnp.repeat(x.reshape(*x.shape[:-1], count, 1, STARTS), KEPT, -2).reshape(*x.shape[:-1], -1)
        start = fresh_walk(crowd.lanes)._replace(state=jax.tree.map(spread, state))
        action = jnp.moveaxis(decode(cycled(new, steps).reshape(count * KEPT, -1).T), 0, 1)
        until = jnp.repeat(jnp.where(reached & active[:, None], steps, 0).reshape(-1), STARTS)
        survived = survivors(crowd, start, jnp.repeat(action, STARTS, -1), until, rules).reshape(count, KEPT, STARTS)
        survived = jnp.where(reached, survived.sum(-1), -1)
        most = survived.max(-1)
        take = active & (most >= 0)
        code, length = best_lane(take, jnp.argmax(survived, axis=-1), (new, steps), (now.code, now.length))
        longest = jnp.minimum(now.length + LATE, RECORD_STEPS)
        env_steps = now.env_steps + jnp.where(active, LANES * now.length + KEPT * STARTS * longest, 0)
        return Strengthening(code, length, now.robust | (take & (most == STARTS)), env_steps, now.number + 1)

    none = jnp.zeros(count, jnp.int32)
    start = Strengthening(code_of(success), success.length, success.length == 0, none, jnp.int32(0))
    end = jax.lax.while_loop(lambda now: (now.number < rounds) & ~now.robust.all(), one, start)
    return Shortened(success_of(end.code, end.length), end.env_steps)


def cycled(code: UInt16[Array, "*some 256"], steps: Int[Array, "*some"]) -> UInt16[Array, "*some 256"]:
    """Repeat the first `steps` codes to the end of the record, as a witness repeats its actions."""
    return jnp.take_along_axis(code, jnp.arange(RECORD_STEPS) % steps[..., None], axis=-1)
