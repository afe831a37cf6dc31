"""Facts about a level that need no expert: how doing nothing ends, and whether actions can change that.

A level is proved unsolvable if doing nothing does not reach the goal and no action changes whether it is reached.
docs/labels.md gives the arguments; any doubt leaves a level unproved.
"""

from dataclasses import astuple, replace
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.levelgen.level import ACTIONS, Level, Role
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.rules import TaskParams, TaskState, advance, has_nan, has_roles, reset
from levelproof.physics.manifold import may_touch
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import Model, Params
from levelproof.physics.vector import rows

MAX_QUANTITY = 1e9  # so that a quantity, or a product of two, is finite: infinity times 0 is not 0


class Proof(IntEnum):
    """Why no action changes whether the goal is reached."""

    NONE = 0  # unknown: an action may change it
    NOTHING_ACTS = 1  # no actuator can change any velocity
    GOAL_STANDS = 2  # whether green touches blue is the same at every step


class Facts(NamedTuple):
    """How the first idle episode ends, and what follows from that."""

    reaches: Bool[Array, " lane"]  # green touches blue
    fails: Bool[Array, " lane"]  # green touches red before it touches blue
    proof: Int[Array, " lane"]  # Proof, of levels that no action solves


class Idle(NamedTuple):
    """How the first idle episode ended: at most one flag, which stays set; none while it lasts."""

    reaches: Bool[Array, " lane"]
    fails: Bool[Array, " lane"]
    lasts: Bool[Array, " lane"]  # the time limit came first
    breaks: Bool[Array, " lane"]  # the world broke down first


@jit_sooner(static_argnames=("rules", "env_steps"))
def examine(level: Level, rules: TaskParams, env_steps: int) -> Facts:
    """Establish the facts by idling for `env_steps` env steps; a longer episode proves nothing."""
    idle = stay_idle(level, rules, env_steps)
    proof = jnp.select(
        [~driven(level).any(0), goal_stands(level, rules.physics)],
        [int(kind) for kind in (Proof.NOTHING_ACTS, Proof.GOAL_STANDS)],
        int(Proof.NONE),
    )
    sound = moderate(level, rules.physics) & (idle.fails | idle.lasts)
    return Facts(idle.reaches, idle.fails, jnp.where(sound, proof, int(Proof.NONE)))


def stay_idle(level: Level, rules: TaskParams, env_steps: int) -> Idle:
    """Do nothing until the first episode ends."""
    lanes = level.role.shape[-1]
    sparse = replace(rules, dense_reward_scale=0.0)
    idle_action = jnp.zeros((ACTIONS, lanes), jnp.int32)

    def act(carry: tuple[TaskState, Idle], _: None) -> tuple[tuple[TaskState, Idle], None]:
        now, so_far = carry
        after, result = advance(level, now, idle_action, sparse)
        going = ~(so_far.reaches | so_far.fails | so_far.lasts | so_far.breaks)
        broken, neither = has_nan(after.state), result.reward == 0
        ending = Idle(
            reaches=result.goal,
            fails=result.reward < 0,
            lasts=result.done & neither & ~broken,
            breaks=broken & neither,
        )
        return (after, Idle(*(old | (new & going) for old, new in zip(so_far, ending, strict=True)))), None

    start = reset(level), Idle(*jnp.zeros((len(Idle._fields), lanes), bool))
    return jax.lax.scan(act, start, length=env_steps)[0][1]


def driven(level: Level) -> Bool[Array, "body lane"]:
    """Find bodies whose velocity an action can change: ends of a joint whose motor obeys, carriers of a thruster."""
    model, body = level.model, jnp.arange(level.size.bodies)[:, None]
    one_hot = lambda index: (index[:, None] == body) & model.active  # [joint or thruster, body, lane]
    a, b = one_hot(model.joint_a), one_hot(model.joint_b)
    holds = model.joint_active & a.any(1) & b.any(1)
    obeys = holds & ~model.joint_fixed & model.motor_on & ~level.motor_auto & (model.motor_power != 0)
    pushes = model.thruster_active & (model.thruster_power != 0)
    acts = ((a | b) & obeys[:, None]).any(0) | (one_hot(model.thruster_body) & pushes[:, None]).any(0)
    return acts & ~immovable(model)


def immovable(model: Model) -> Bool[Array, "body lane"]:
    """Find bodies that no impulse moves."""
    return (model.inverse_mass == 0) & (model.inverse_inertia == 0)


def goal_stands(level: Level, params: Params) -> Bool[Array, " lane"]:
    """Whether both bodies stay still in every pair of green and blue that may touch."""
    moves, moving_goals = ~still(level, params), []
    pairs = pairs_of(level.size)
    for pair in (pairs.polygon, pairs.circle_polygon, pairs.circle):
        a, b = np.array(pair.a, int), np.array(pair.b, int)
        goal = has_roles(level, pair.a, pair.b, Role.GREEN, Role.BLUE) & may_touch(level.model, a, b)
        moving_goals.append((goal & (rows(moves, pair.a) | rows(moves, pair.b))).any(0))
    return ~jnp.stack(moving_goals).any(0)


def still(level: Level, params: Params) -> Bool[Array, "body lane"]:
    """Find bodies that stay where they are, whatever happens."""
    state = level.state
    rests = (state.velocity == 0).all(1) & (state.angular_velocity == 0)
    return immovable(level.model) & rests & (jnp.abs(state.position) <= params.max_position).all(1)


def moderate(level: Level, params: Params) -> Bool[Array, " lane"]:
    """Whether all values of a level and of the engine are finite and at most MAX_QUANTITY."""
    floats = [x for x in jax.tree.leaves((level.model, level.state)) if x.dtype == jnp.float32]
    small = [(jnp.abs(x) <= MAX_QUANTITY).all(tuple(range(x.ndim - 1))) for x in floats]
    return jnp.stack(small).all(0) & all(abs(x) <= MAX_QUANTITY for x in astuple(params))
