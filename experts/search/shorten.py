"""Shortening of a success, in rounds: lanes play edits of the shortest success so far, and the shortest edit stays.

`shorten` leaves out or holds stretches, for a few rounds. `polish` also resamples them, until its env steps are spent;
among edits as short as the success it keeps the one nearest to the goal one step earlier, because that one can become
a step shorter.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.edit import Draws, draw, edits, shortening, variation
from levelproof.experts.search.play import Arena, Walk, act, arena, best_lane, code_of, decode, fresh_walk, success_of
from levelproof.experts.witness.success import Success
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.measures import goal_distance
from levelproof.levelgen.task.rules import TaskParams

LANES = 16  # per level that is polished: few, so that there are many rounds


class Shortened(NamedTuple):
    """Shortened successes, level first."""

    success: Success  # length 0: the given success does not reach the goal
    env_steps: Int[Array, " level"]  # of all lanes


class Polishing(NamedTuple):
    """State of polishing, level first."""

    code: UInt16[Array, "level step"]  # codes of the success's actions
    length: Int[Array, " level"]  # of the success, env steps
    near: Float[Array, " level"]  # m, distance of green and blue one env step before the goal; infinity: unknown
    env_steps: Int[Array, " level"]  # of all lanes
    number: Int[Array, ""]  # of rounds done


@jit_sooner(static_argnames=("config", "rules"))
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
    ring = arena(levels, config.lanes, config.resample)

    def trial(number: Int[Array, ""], now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        code, length, env_steps = now
        bits = draw(Draws.SHORTEN, level_ids, number, 6, config.lanes)
        new = edits(shortening, code, length, bits, ring)
        new = new.at[:, 0].set(jnp.where(number == 0, code, new[:, 0]))
        steps, _ = replayed(ring, new, length, rules)
        shorter = (steps.min(-1) < length) | (number == 0)
        code, shortest = best_lane(shorter, jnp.argmin(steps, axis=-1), (new, steps), (code, length))
        return code, shortest, env_steps + config.lanes * length

    start = code_of(success), success.length, jnp.zeros_like(success.length)
    code, length, env_steps = jax.lax.fori_loop(0, config.trials, trial, start)
    return Shortened(success_of(code, jnp.where(length > RECORD_STEPS, 0, length)), env_steps)


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

    def active(now: Polishing) -> Bool[Array, " level"]:
        return (now.length > 1) & (now.env_steps < env_steps)

    def one(now: Polishing) -> Polishing:
        runs, length = active(now), now.length[:, None]
        new = edits(variation, now.code, now.length, draw(Draws.POLISH, level_ids, now.number, 10, LANES), ring)
        steps, near = replayed(ring, new, jnp.where(runs, now.length, 0), rules, measured=True)
        lane = jnp.argmin(jnp.where(steps == steps.min(-1, keepdims=True), near, jnp.inf), axis=-1)
        better = (steps < length) | ((steps == length) & (near < now.near[:, None]))
        better = runs & jnp.take_along_axis(better, lane[:, None], axis=1)[:, 0]
        near = jnp.where(steps < length, jnp.inf, near)
        best = best_lane(better, lane, (new, steps, near), (now.code, now.length, now.near))
        return Polishing(*best, now.env_steps + jnp.where(runs, LANES * now.length, 0), now.number + 1)

    none = jnp.zeros_like(success.length)
    start = Polishing(code_of(success), success.length, jnp.full(none.shape, jnp.inf), none, jnp.int32(0))
    end = jax.lax.while_loop(lambda now: active(now).any(), one, start)
    return Shortened(success_of(end.code, end.length), end.env_steps)


def replayed(
    ring: Arena,
    code: UInt16[Array, "level lane 256"],
    most: Int[Array, " level"],
    rules: TaskParams,
    enough: int = 1,
    measured: bool = False,
) -> tuple[Int[Array, "level lane"], Float[Array, "level lane"]]:
    """Play each lane's actions from its level's start, for at most this many env steps.

    A level is done once `enough` of its lanes have reached the goal, because the others would take longer.

    Returns:
        Env steps until the goal, RECORD_STEPS + 1 if it is not reached; and, in lanes that reach it in env step `most`,
        the distance of green and blue one env step earlier, m; 0 in other lanes, or if not `measured`.
    """
    by_step, last = code.reshape(-1, RECORD_STEPS).T, jnp.repeat(most, code.shape[1])

    def step(now: tuple[Walk, Array]) -> tuple[Walk, Array]:
        walk, near = now
        walk = act(ring, walk, decode(by_step[walk.timestep[0]]), rules)
        if measured:
            near = jnp.where(walk.timestep == last - 1, goal_distance(ring.lanes, walk.state), near)
        return walk, near

    by_level = lambda x: x.reshape(code.shape[:2])

    def going(now: tuple[Walk, Array]) -> Bool[Array, ""]:
        walk = now[0]
        few = (by_level(walk.reached) > 0).sum(-1) < enough
        return (few & (walk.timestep[0] < most) & ~by_level(walk.ended).all(-1)).any()

    walk, near = jax.lax.while_loop(going, step, (fresh_walk(ring.lanes), jnp.zeros(len(last))))
    steps = jnp.where((walk.reached > 0) & (walk.reached <= last), walk.reached, RECORD_STEPS + 1)
    return by_level(steps), by_level(jnp.where(steps == last, near, 0.0))
