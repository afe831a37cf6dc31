"""Portability of a witness: the share of its replays that reach the goal from starts perturbed by a rounding error.

A witness holds for the bits of one machine. Another machine, or the reference's physics, rounds differently, and in a
chaotic world the same actions then miss the goal. A level's witness is its most portable candidate.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.play import Arena, Walk, act, arena, fresh_walk
from levelproof.experts.verdict.judge import Witness
from levelproof.levelgen.batching import at_once, block_size, blocks, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import State

LATE = 16  # env steps that a replay may take longer than the candidate
PORTABLE = 0.95  # portability below which a more robust witness is sought
IN_CACHE = 32  # lanes of candidates side by side


def choose(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    candidates: Sequence[Sequence[Witness]],
    replays: int,
    rules: TaskParams,
) -> list[Witness | None]:
    """Choose each level's most portable candidate, the first if several tie; return it with its portability.

    Candidates after one that survives all replays are not replayed, nor are candidates of known portability.

    Args:
        levels: the levels, on the host.
        level_ids: their ids, the seeds of all randomness.
        candidates: candidates of each level, perhaps none.
        replays: replays per candidate; 0: choose the first, of unknown portability.
        rules: the task's rules.
    """
    best = [next(iter(some), None) for some in candidates]
    shares = np.full(len(best), -1.0)
    left = [i for i, witness in enumerate(best) if witness is not None and replays]
    rank = 0
    while left:
        now = {i: candidates[i][rank] for i in left}
        new = [i for i, witness in now.items() if witness.portability is None]
        survived = survival(take(levels, np.array(new, int)), level_ids[new], [now[i] for i in new], replays, rules)
        now |= {i: now[i]._replace(portability=share) for i, share in zip(new, survived.tolist(), strict=True)}
        for i, witness in now.items():
            if witness.portability is not None and witness.portability > shares[i]:
                best[i], shares[i] = witness, witness.portability
        rank += 1
        left = [i for i in left if rank < len(candidates[i]) and shares[i] < 1]
    return best


def survival(
    levels: Level, level_ids: Int[np.ndarray, " level"], witnesses: Sequence[Witness], replays: int, rules: TaskParams
) -> Float[np.ndarray, " level"]:
    """Return the share of replays that reach the goal, for one witness per level; levels are independent.

    Args:
        levels: the levels, on the host; a level with several witnesses is repeated.
        level_ids: their ids, the seeds of all randomness.
        witnesses: one per level.
        replays: replays per witness, from the same starts for all witnesses of a level.
        rules: the task's rules.
    """
    shares, size = [], block_size(len(witnesses), at_once(replays, IN_CACHE))
    for some in blocks(len(witnesses), size):
        action = np.stack([witnesses[i].action for i in some], -1).astype(np.int8)
        steps = np.array([witnesses[i].steps for i in some], np.int32)
        given = take(levels, some), level_ids[some], action, steps
        shares.append(jax.device_get(survival_block(*given, replays, rules)))
    return np.concatenate([np.zeros(0, np.float32), *shares])[: len(witnesses)]


@jit_sooner(static_argnames=("replays", "rules"))
def survival_block(
    levels: Level,
    level_ids: Int[Array, " level"],
    action: Int[Array, "256 6 level"],
    steps: Int[Array, " level"],
    replays: int,
    rules: TaskParams,
) -> Float[Array, " level"]:
    ring = arena(levels, replays, (1.0,))
    start = fresh_walk(ring.lanes)._replace(state=moved(ring.lanes, level_ids, replays))
    reached = survivors(ring, start, jnp.repeat(action, replays, -1), jnp.repeat(steps, replays), rules)
    return reached.reshape(-1, replays).mean(-1)


def survivors(
    ring: Arena, start: Walk, action: Int[Array, "256 6 lane"], steps: Int[Array, " lane"], rules: TaskParams
) -> Bool[Array, " lane"]:
    """Return whether each lane reaches the goal within `steps` + LATE env steps; steps 0: the lane does not play."""
    last = jnp.where(steps > 0, jnp.minimum(steps + LATE, RECORD_STEPS), 0)

    def step(walk: Walk) -> Walk:
        walk = act(ring, walk, action[walk.timestep[0]].astype(jnp.int32), rules)
        return walk._replace(ended=walk.ended | (walk.timestep >= last))

    going = lambda walk: ~walk.ended.all()
    return jax.lax.while_loop(going, step, start._replace(ended=last == 0)).reached > 0


def moved(lanes: Level, level_ids: Int[Array, " level"], replays: int, number: Int[Array, ""] | int = 0) -> State:
    """Perturb first states: change each number of a movable body by -1, 0 or 1 unit in the last place.

    Zeros stay: their neighbours are subnormal, and count as zero.

    Args:
        lanes: `replays` lanes per level, level by level.
        level_ids: ids of the levels.
        replays: number of states per level.
        number: index of this set of states; another index gives other states.
    """
    state, model = lanes.state, lanes.model
    movable = model.active & ((model.inverse_mass > 0) | (model.inverse_inertia > 0))

    def move(field: int, x: Array, these: Bool[Array, "..."]) -> Array:
        def draw(level_id):
            key = jax.random.fold_in(key_for(level_id, Stream.PORTABILITY), 4 * number + field)
            return jax.random.randint(key, (*x.shape[:-1], replays), -1, 2)

        by = jnp.moveaxis(jax.vmap(draw)(level_ids), 0, -2).reshape(x.shape)
        return jnp.where(these & (by != 0), jnp.nextafter(x, jnp.where(by > 0, jnp.inf, -jnp.inf)), x)

    return replace(
        state,
        position=move(0, state.position, movable[:, None]),
        rotation=move(1, state.rotation, movable),
        velocity=move(2, state.velocity, movable[:, None]),
        angular_velocity=move(3, state.angular_velocity, movable),
    )
