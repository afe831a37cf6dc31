"""Witnesses: actions that solve a level, and the record that replaying them gives.

A record is RECORD_STEPS env steps with automatic reset to the same level. Records are made by `replay` alone, from a
level and its actions, always in blocks of LANES lanes of one compiled program: a level's bits do not depend on how
many others are replayed with it.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.rules import DEFAULT_RULES, StepResult, TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold, State
from levelproof.physics.vector import select, unvec, vec


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Record:
    """What happened in 256 env steps with automatic reset: numpy arrays, time first, levels (`lane`) last; SI units."""

    state: State  # [256, ..., level]: before each action
    manifold: Manifold  # [256, contact, ..., level]: of the physics step that led there; zero at an episode's start
    joint_point: Float[Array, "256 joint 2 lane"]  # m, where the joint sits on its body a
    thruster_point: Float[Array, "256 thruster 2 lane"]  # m
    timestep: Int[Array, "256 lane"]  # env steps since the episode's start
    last_distance: Float[Array, "256 lane"]  # m; -1 at an episode's start
    action: Int[Array, "256 6 lane"]
    reward: Float[Array, "256 lane"]
    done: Bool[Array, "256 lane"]
    goal: Bool[Array, "256 lane"]


def replay(level: Level, action: ArrayLike, rules: TaskParams = DEFAULT_RULES) -> Record:
    """What happens in 256 env steps under these actions, as numpy arrays.

    The same bits on the same machine and versions, at any count of levels.

    Args:
        level: levels, level axis last.
        action: int [256, 6, level], multi-discrete: one entry a binding (`levelgen.task.actions`).
        rules: of the task.
    """
    level = jax.tree.map(np.asarray, level)
    actions = np.asarray(action, np.int32)
    count = actions.shape[-1]
    parts = [jax.device_get(_replay_block(take(level, lanes), actions[..., lanes], rules)) for lanes in blocks(count)]
    return jax.tree.map(lambda *xs: np.ascontiguousarray(np.concatenate(xs, -1)[..., :count]), *parts)


def succeeds(done: ArrayLike, goal: ArrayLike) -> Bool[np.ndarray, "..."]:
    """Whether episodes ended, and every one that did ended in the goal, of flags [time, ...]."""
    done, goal = np.asarray(done), np.asarray(goal)
    return np.asarray(done.any(0) & (goal | ~done).all(0))


def steps_to_goal(done: ArrayLike) -> Int[np.ndarray, " level"]:
    """Length of the first episode, env steps, of flags [time, level]."""
    return np.argmax(np.asarray(done), axis=0) + 1


@partial(jax.jit, static_argnames="rules")
def _replay_block(level: Level, action: Int[Array, "256 6 lane"], rules: TaskParams) -> Record:
    def act(carry: tuple[TaskState, Manifold], action):
        now, manifold = carry
        after, outcome, _, contacts = task.advance_driven(level, now, controls(level, action), rules, seen=True)
        return onwards(level, after, contacts, outcome.done), record_of(level, now, manifold, action, outcome)

    start = task.reset(level)
    return jax.lax.scan(act, (start, zeros_of(Manifold, level.size, len(start.timestep))), action)[1]


def onwards(level: Level, after: TaskState, contacts: Any, done: Bool[Array, " lane"]) -> tuple[TaskState, Any]:
    """Where the next env step starts, and the contacts that led there: none where an episode begins."""
    return task.restart(level, after, done), jax.tree.map(lambda x: jnp.where(done, jnp.zeros_like(x), x), contacts)


def record_of(level: Level, now: TaskState, manifold: Any, action: Int[Array, "6 lane"], outcome: StepResult) -> Record:
    """A row of a record."""
    model = level.model
    return Record(
        now.state,
        manifold,
        _points(now.state, model.joint_a, model.joint_anchor_a),
        _points(now.state, model.thruster_body, model.thruster_position),
        now.timestep,
        now.last_distance,
        action,
        *outcome,
    )


def _points(state: State, body: Int[Array, "thing lane"], point: Float[Array, "thing 2 lane"]) -> Array:
    """Points given in the frames of bodies, in the world."""
    if not len(body):
        return jnp.zeros_like(point)
    pick = lambda x: jnp.stack([select(x, b) for b in body])
    rotation = pick(state.rotation)
    centre = vec(state.position).map(pick)
    return unvec(vec(point).rotate(jnp.cos(rotation), jnp.sin(rotation)) + centre)
