"""Witnesses: actions that solve a level, and the record of replaying them.

A record is RECORD_STEPS env steps with automatic reset to the same level. Only `replay` makes records, from a level and
its actions, in blocks of LANES lanes of one compiled program, so that a level's bits do not depend on the number of
levels replayed with it.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.batching import by_blocks, take
from levelproof.levelgen.level import ACTIONS, Level, expanded
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.measures import world_points
from levelproof.levelgen.task.rules import DEFAULT_RULES, StepResult, TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold, State


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Record:
    """256 env steps with automatic reset, as numpy arrays: time first, levels (`lane`) last, SI units."""

    state: State  # [256, ..., level]: before each action
    manifold: Manifold  # [256, contact, ..., level]: of the physics step that led there; zero at an episode's start
    joint_point: Float[Array, "256 joint 2 lane"]  # m, the joint's anchor on body a
    thruster_point: Float[Array, "256 thruster 2 lane"]  # m
    timestep: Int[Array, "256 lane"]  # env steps since the episode's start
    last_distance: Float[Array, "256 lane"]  # m; -1 at an episode's start
    action: Int[Array, "256 6 lane"]
    reward: Float[Array, "256 lane"]
    done: Bool[Array, "256 lane"]
    goal: Bool[Array, "256 lane"]


def replay(level: Level, action: ArrayLike, rules: TaskParams = DEFAULT_RULES) -> Record:
    """Play RECORD_STEPS (256) env steps with these actions; return numpy arrays.

    On one machine and set of versions, the bits are the same for any number of levels.

    Args:
        level: levels, level axis last.
        action: int [256, 6, level], multi-discrete: one entry per binding (`levelgen.task.actions`).
        rules: the task's rules.

    Raises:
        ValueError: there are no levels, or the actions have another shape.
        TypeError: the actions are not integers.
    """
    level, actions = expanded(level), np.asarray(action)
    count = len(level)
    if actions.dtype.kind not in "iub":
        raise TypeError(f"the actions are {actions.dtype}, but must be integers: convert them")
    if not count or actions.shape != (RECORD_STEPS, ACTIONS, count):
        raise ValueError(
            f"there are {count} levels and actions of shape {actions.shape}: pass at least one level, and actions of "
            f"shape ({RECORD_STEPS}, {ACTIONS}, levels)"
        )
    actions = actions.astype(np.int32, copy=False)
    record = by_blocks(lambda lanes: replay_block(take(level, lanes), actions[..., lanes], rules), count)
    return jax.tree.map(np.ascontiguousarray, record)


def succeeds(done: ArrayLike, goal: ArrayLike) -> Bool[np.ndarray, "..."]:
    """Return whether at least one episode ended and every one that ended reached the goal, from flags [time, ...]."""
    done, goal = np.asarray(done), np.asarray(goal)
    return np.asarray(done.any(0) & (goal | ~done).all(0))


def steps_to_goal(done: ArrayLike) -> Int[np.ndarray, " level"]:
    """Return the length of the first episode, env steps, from flags [time, level]."""
    return np.argmax(np.asarray(done), axis=0) + 1


@jit_sooner(static_argnames="rules")
def replay_block(level: Level, action: Int[Array, "256 6 lane"], rules: TaskParams) -> Record:
    def act(carry: tuple[TaskState, Manifold], action):
        now, manifold = carry
        after, outcome, _, contacts = task.advance_driven(
            level, now, controls(level, action), rules, with_contacts=True
        )
        return onwards(level, after, contacts, outcome.done), record_of(level, now, manifold, action, outcome)

    start = task.reset(level)
    return jax.lax.scan(act, (start, zeros_of(Manifold, level.size, len(start.timestep))), action)[1]


def onwards(level: Level, after: TaskState, contacts: Any, done: Bool[Array, " lane"]) -> tuple[TaskState, Any]:
    """Return the start of the next env step, and the contacts that led there: zero in lanes where an episode begins."""
    return task.restart(level, after, done), jax.tree.map(lambda x: jnp.where(done, jnp.zeros_like(x), x), contacts)


def record_of(level: Level, now: TaskState, manifold: Any, action: Int[Array, "6 lane"], outcome: StepResult) -> Record:
    """Make a row of a record."""
    model = level.model
    return Record(
        now.state,
        manifold,
        world_points(now.state, model.joint_a, model.joint_anchor_a),
        world_points(now.state, model.thruster_body, model.thruster_position),
        now.timestep,
        now.last_distance,
        action,
        *outcome,
    )
