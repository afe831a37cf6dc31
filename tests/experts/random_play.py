"""Successes of persistent random play: robust and fragile witnesses for tests, without a search or an expert."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.search import Searching
from levelproof.experts.witness.success import Success, ending_at
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.rules import DEFAULT_RULES

LANES = 64  # per level
REDRAWN = (0.02, 0.05, 0.1, 0.3)  # probability of resampling an entry of the action, each in a quarter of the lanes


def random_successes(levels: Level, level_ids: Int[np.ndarray, " level"]) -> Success:
    """Play each level for 256 env steps in 64 lanes; return its shortest success (length 0: none), level first."""
    return jax.device_get(_play(levels, level_ids))


def searched_randomly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make random play stand in for the search of a `TrainingRun` whose procedure has none."""
    played = lambda _, job: job.known._replace(success=random_successes(job.levels, job.level_ids))
    monkeypatch.setattr(Searching, "result", played)


@jax.jit
def _play(levels: Level, level_ids: Int[Array, " level"]) -> Success:
    count, lanes = len(level_ids), repeat(levels, LANES)
    live, choices = action_mask(lanes), jnp.array(CHOICES, jnp.uint32)[:, None]
    keys = jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, Stream.SCOUT), 0))(level_ids)
    chance = jnp.tile(jnp.repeat(jnp.array(REDRAWN), LANES // len(REDRAWN)), count)

    def act(carry, t):
        now, last = carry
        draw = lambda key: jax.random.bits(jax.random.fold_in(key, t), (len(CHOICES), LANES), jnp.uint32)
        bits = jnp.moveaxis(jax.vmap(draw)(keys), 0, 1).reshape(len(CHOICES), -1)
        redraw = ((bits >> 16) < (chance * 2**16).astype(jnp.uint32)) | (now.timestep == 0)
        action = jnp.where(redraw, ((bits & 0xFFFF) * choices >> 16).astype(jnp.int32), last)
        action = jnp.where(live, action, 0)
        after, outcome = task.step(lanes, now, action, DEFAULT_RULES)
        return (after, action), (action.astype(jnp.int8), outcome.goal, now.timestep)

    start = task.reset(lanes), jnp.zeros((len(CHOICES), count * LANES), jnp.int32)
    played = jax.lax.scan(act, start, jnp.arange(RECORD_STEPS))[1]
    by_level = [jnp.moveaxis(x.reshape(*x.shape[:-1], count, LANES), -2, 0) for x in played]
    return jax.vmap(_shortest)(*by_level)


def _shortest(action: Array, goal: Array, timestep: Array) -> Success:
    length = jnp.where(goal, timestep + 1, RECORD_STEPS + 1)
    time, lane = jnp.divmod(jnp.argmin(length.reshape(-1)), length.shape[1])
    return ending_at(action, time, lane, jnp.where(goal.any(), length[time, lane], 0))
