"""What can be said of a level without an expert: how doing nothing ends, and whether actions can change that.

A level is proved unsolvable where doing nothing does not reach the goal, and no action changes whether it is reached.
docs/labels.md gives the arguments; every doubt leaves a level unproved.
"""

from dataclasses import astuple, replace
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from levelgen.arms import Arms, driven, find_arms, still, within_reach
from levelgen.level import ACTIONS, Level, Role
from levelgen.task.rules import TaskParams, TaskState, advance_seen, has_nan, has_roles, reset
from physics.pairs import PairKind, pairs_of
from physics.types import Model, Params
from physics.vector import rows

LARGEST = 1e9  # of any quantity: what is multiplied by zero has to be a number, and so do products of two of them


class Proof(IntEnum):
    """Why no action changes whether the goal is reached."""

    NONE = 0  # it may: nothing is known
    NOTHING_ACTS = 1  # no actuator can change any velocity
    GOAL_STANDS = 2  # whether green touches blue is the same at every step
    OUT_OF_REACH = 3  # what acts are arms, and all that moves stays out of their reach


class Facts(NamedTuple):
    """How the first episode of doing nothing ends, and what that decides."""

    reaches: Bool[Array, " lane"]  # green touches blue
    fails: Bool[Array, " lane"]  # green touches red, without that
    proof: Int[Array, " lane"]  # Proof, of levels that no action solves


class Idle(NamedTuple):
    """Doing nothing, so far. At most one of the first four holds, from when it happened on."""

    reaches: Bool[Array, " lane"]
    fails: Bool[Array, " lane"]
    lasts: Bool[Array, " lane"]  # the time limit came first
    breaks: Bool[Array, " lane"]  # the world broke down first
    disturbed: Bool[Array, " lane"]  # an arm could have had an effect before that


@partial(jax.jit, static_argnames=("rules", "env_steps"))
def examine(level: Level, rules: TaskParams, env_steps: int) -> Facts:
    """The facts, from watching `env_steps` env steps; an episode that lasts longer proves nothing."""
    arms = find_arms(level, rules.physics)
    idle = stay_idle(level, arms, rules, env_steps)
    proof = jnp.select(
        [~driven(level).any(0), goal_stands(level, rules.physics), arms.known & ~idle.disturbed],
        [int(kind) for kind in (Proof.NOTHING_ACTS, Proof.GOAL_STANDS, Proof.OUT_OF_REACH)],
        int(Proof.NONE),
    )
    sound = moderate(level, rules.physics) & (idle.fails | idle.lasts)
    return Facts(idle.reaches, idle.fails, jnp.where(sound, proof, int(Proof.NONE)))


def stay_idle(level: Level, arms: Arms, rules: TaskParams, env_steps: int) -> Idle:
    """Do nothing, physics step by physics step: what happens is what happens to it in env steps."""
    lanes, skip = level.role.shape[-1], rules.frame_skip
    frame = replace(rules, frame_skip=1, max_timesteps=rules.max_timesteps * skip, dense_reward_scale=0.0)
    nothing = jnp.zeros((ACTIONS, lanes), jnp.int32)

    def act(carry: tuple[TaskState, Idle], _) -> tuple[tuple[TaskState, Idle], None]:
        now, so_far = carry
        after, outcome, _ = advance_seen(level, now, nothing, frame)
        going = ~(so_far.reaches | so_far.fails | so_far.lasts | so_far.breaks)
        broken = has_nan(after.state)
        mixed = (after.state.contact_active & arms.mixing).any(0)
        happened = Idle(
            reaches=outcome.goal,
            fails=outcome.reward < 0,
            lasts=outcome.done & (outcome.reward == 0) & ~broken,
            breaks=broken & (outcome.reward == 0),
            disturbed=within_reach(arms, level.model, now.state) | mixed,
        )
        return (after, Idle(*(old | (new & going) for old, new in zip(so_far, happened, strict=True)))), None

    start = reset(level), Idle(*jnp.zeros((len(Idle._fields), lanes), bool))
    return jax.lax.scan(act, start, length=env_steps * skip)[0][1]


def moderate(level: Level, params: Params) -> Bool[Array, " lane"]:
    """Whether every number of a level and of the engine is one, and no larger than LARGEST."""
    floats = [x for x in jax.tree.leaves((level.model, level.state)) if x.dtype == jnp.float32]
    small = [(jnp.abs(x) <= LARGEST).all(tuple(range(x.ndim - 1))) for x in floats]
    return jnp.stack(small).all(0) & all(abs(x) <= LARGEST for x in astuple(params))


def goal_stands(level: Level, params: Params) -> Bool[Array, " lane"]:
    """Every pair of a green and a blue body that may touch is still."""
    moves, found = ~still(level, params), []
    pairs = pairs_of(level.size)
    for pair in (pairs.polygon, pairs.circle_polygon, pairs.circle):
        goal = has_roles(level, pair.a, pair.b, Role.GREEN, Role.BLUE) & may_touch(level.model, pair)
        found.append((goal & (rows(moves, pair.a) | rows(moves, pair.b))).any(0))
    return ~jnp.stack(found).any(0)


def may_touch(model: Model, pair: PairKind) -> Bool[Array, "pair lane"]:
    """Both bodies are active and their collision modes allow it, as in `physics.manifold`."""
    mode_a, mode_b = rows(model.collision_mode, pair.a), rows(model.collision_mode, pair.b)
    modes = (mode_a == 2) | (mode_b == 2) | (mode_a * mode_b > 0)
    return modes & rows(model.active, pair.a) & rows(model.active, pair.b)
