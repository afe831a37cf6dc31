"""Success rates of experts, from attempts that decide nothing.

Training ends with an evaluation selected for its successes, so that evaluation's success rate is biased upwards.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.policy import Params, network_of
from levelproof.experts.training.rollout import Acting, ActionRule, rollout, start
from levelproof.experts.verdict.portability import IN_CACHE
from levelproof.levelgen.batching import at_once, blocks, repeat, stacked, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.rules import TaskParams

PART = 16  # env steps between checks whether all attempts have ended


class AttemptResults(NamedTuple):
    """Results of first episodes under sampled actions."""

    success_rate: Float[np.ndarray, " level"]  # share of attempts
    env_steps: Int[np.ndarray, " level"]  # of all attempts


class _Attempting(NamedTuple):
    acting: Acting
    part: Int[Array, ""]
    ended: Bool[Array, "level attempt"]
    reached: Bool[Array, "level attempt"]
    env_steps: Int[Array, " level"]


def attempt(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    policies: Sequence[Params],
    config: ExpertConfig,
    rules: TaskParams,
) -> AttemptResults:
    """Run `expert.attempts` attempts per level, each at most as long as a record.

    Args:
        levels: the levels, on the host.
        level_ids: their ids, the seeds of all randomness.
        policies: parameters of their experts, on the host.
        config: settings of the experts.
        rules: the task's rules.
    """
    parts = [AttemptResults(np.zeros(0, np.float32), np.zeros(0, np.int32))]
    for some in blocks(len(level_ids), at_once(config.attempts, IN_CACHE)):
        params = stacked(policies[i] for i in some)
        parts.append(jax.device_get(attempt_block(take(levels, some), level_ids[some], params, config, rules)))
    return AttemptResults(*(np.concatenate(column)[: len(level_ids)] for column in zip(*parts, strict=True)))


@jit_sooner(static_argnames=("config", "rules"))
def attempt_block(
    levels: Level, level_ids: Int[Array, " level"], params: Params, config: ExpertConfig, rules: TaskParams
) -> AttemptResults:
    network, shape = network_of(levels.size, config), (len(level_ids), config.attempts)
    no, manner = jnp.zeros(shape, bool), ActionRule.sampling(math.prod(shape), len(level_ids))
    keys = jax.vmap(lambda level_id: key_for(level_id, Stream.SUCCESS_RATE))(level_ids)

    def act(now: _Attempting) -> _Attempting:
        key = jax.vmap(jax.random.fold_in, (0, None))(keys, now.part)
        acting, trajectory, _ = rollout(network, params, levels, now.acting, key, manner, PART, rules)
        ends, first = trajectory.done.any(0), jnp.argmax(trajectory.done, 0)
        goal = jnp.take_along_axis(trajectory.goal, first[None], 0)[0]
        steps = jnp.where(now.ended, 0, jnp.where(ends, first + 1, PART)).sum(1)
        reached = now.reached | (~now.ended & ends & goal)
        return _Attempting(acting, now.part + 1, now.ended | ends, reached, now.env_steps + steps)

    going = lambda now: (now.part < RECORD_STEPS // PART) & ~now.ended.all()
    first = _Attempting(start(repeat(levels, config.attempts)), jnp.int32(0), no, no, jnp.zeros(shape[0], jnp.int32))
    after = jax.lax.while_loop(going, act, first)
    return AttemptResults(after.reached.mean(1), after.env_steps)  # pyright: ignore[reportArgumentType]
