"""The task: make green and blue touch, never green and red. Reward, end of an episode, automatic reset.

Facts: `kinetix.environment.env` 3.0.2.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.task.actions import Controls, controls
from levelproof.levelgen.task.measures import goal_distance
from levelproof.physics.bounds import require
from levelproof.physics.pairs import pairs_of
from levelproof.physics.step import step as physics_step
from levelproof.physics.types import Params, State
from levelproof.physics.vector import rows, select

MAX_STEPS = 10**6
MAX_REWARD_SCALE = 1_000_000  # 1/m
NO_DISTANCE = -1.0  # last_distance before the first step of an episode


@dataclass(frozen=True)
class TaskParams:
    """Rules of the task (hashable: pass as a static argument)."""

    frame_skip: int = 2  # physics steps per env step, with the same action
    max_timesteps: int = 256  # env steps after which an episode ends
    dense_reward_scale: float = 0.1  # 1/m; reward for each metre that green and blue come closer; 0: none
    physics: Params = field(default_factory=Params)  # constants of the engine

    def __post_init__(self) -> None:
        require(self, ("frame_skip", "max_timesteps"), 1, MAX_STEPS)
        require(self, ("dense_reward_scale",), 0, MAX_REWARD_SCALE)


DEFAULT_RULES = TaskParams()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TaskState:
    """An episode under way."""

    state: State
    timestep: Int[Array, " lane"]  # env steps taken in this episode
    last_distance: Float[Array, " lane"]  # m, between green and blue, summed over pairs; NO_DISTANCE at the start


class StepResult(NamedTuple):
    """The result of one env step."""

    reward: Float[Array, " lane"]
    done: Bool[Array, " lane"]
    goal: Bool[Array, " lane"]  # ended because green touched blue


class StepEnd(NamedTuple):
    """The end of an env step, before any reset."""

    distance: Float[Array, " lane"]  # between green and blue, summed over pairs, m
    terminated: Bool[Array, " lane"]  # by the task, not by the time limit alone: the next state's value is 0


def reset(level: Level) -> TaskState:
    """Return the first state of an episode in every lane."""
    lanes = level.state.rotation.shape[-1]
    return TaskState(level.state, jnp.zeros(lanes, jnp.int32), jnp.full(lanes, NO_DISTANCE, jnp.float32))


def has_roles(level: Level, a, b, first: Role, second: Role) -> Bool[Array, "pair lane"]:
    """Whether a pair of active bodies has these two roles, in either order."""
    role = jnp.where(level.model.active, level.role, Role.PLAIN)
    role_a, role_b = rows(role, a), rows(role, b)
    return ((role_a == first) & (role_b == second)) | ((role_a == second) & (role_b == first))


def touches(level: Level, active: Bool[Array, "contact lane"], first: Role, second: Role) -> Bool[Array, " lane"]:
    """Whether bodies of these roles are in contact.

    For a pair of polygons, only the first contact point counts; for a pair with a circle, its one contact.
    """
    pairs = pairs_of(level.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    at = {0: pairs.polygon, 2 * n: pairs.circle_polygon, 2 * n + m: pairs.circle}
    hits = [
        (has_roles(level, pair.a, pair.b, first, second) & active[start : start + len(pair)]).any(0)
        for start, pair in at.items()
        if len(pair)
    ]
    return jnp.stack(hits).any(0)


def advance(
    level: Level, now: TaskState, action: Int[Array, "6 lane"], params: TaskParams
) -> tuple[TaskState, StepResult]:
    """Take one env step without reset: return the next state and the step's result."""
    return advance_driven(level, now, controls(level, action), params)[:2]


def advance_driven(
    level: Level, now: TaskState, driven: Controls, params: TaskParams, with_contacts: bool = False
) -> tuple[TaskState, StepResult, StepEnd, Any]:
    """Take one env step without reset under controls, whatever type of action they come from.

    Returns the next state, the result, the step's end, and the contacts of the last physics step, if `with_contacts`.
    """
    motor, thrust = driven

    def frame(state, _):
        state, manifold = physics_step(level.model, state, motor, thrust, params.physics, with_contacts)
        fail = touches(level, state.contact_active, Role.GREEN, Role.RED)
        goal = touches(level, state.contact_active, Role.GREEN, Role.BLUE) & ~fail
        return state, (goal, fail, goal_distance(level, state), manifold)

    state, (goals, fails, distances, manifolds) = jax.lax.scan(frame, now.state, None, length=params.frame_skip)
    ended = goals | fails
    first = jnp.argmax(ended, axis=0)  # the first physics step that ended the episode counts
    at_end = lambda x: select(x, jnp.where(ended.any(0), first, params.frame_skip - 1))
    goal = select(goals, first)
    distance = at_end(distances)
    timestep = now.timestep + 1
    terminated = ended.any(0) | has_nan(state)
    done = terminated | (timestep >= params.max_timesteps)

    closer = jnp.nan_to_num(now.last_distance - distance, nan=0.0, posinf=0.0, neginf=0.0)
    shaping = jnp.where(now.last_distance == NO_DISTANCE, 0.0, params.dense_reward_scale * closer)
    reward = goal.astype(jnp.float32) - select(fails, first).astype(jnp.float32) + shaping
    after = TaskState(state, timestep, jnp.where(done, NO_DISTANCE, distance))
    return (
        after,
        StepResult(reward, done, goal),
        StepEnd(distance, terminated),
        jax.tree.map(lambda x: x[-1], manifolds),
    )


def has_nan(state: State) -> Bool[Array, " lane"]:
    """Whether a lane's world has broken down: a position, angle or velocity is NaN."""
    leaves = (state.position, state.rotation, state.velocity, state.angular_velocity)
    return jnp.stack([jnp.isnan(x).any(tuple(range(x.ndim - 1))) for x in leaves]).any(0)


def restart(level: Level, state: TaskState, done: Bool[Array, " lane"]) -> TaskState:
    """Replace the state of the lanes that are done by their level's first state."""
    return jax.tree.map(lambda fresh, x: jnp.where(done, fresh, x), reset(level), state)


def step(
    level: Level, now: TaskState, action: Int[Array, "6 lane"], params: TaskParams = DEFAULT_RULES
) -> tuple[TaskState, StepResult]:
    """Take one env step with automatic reset to the same level.

    Args:
        level: the level of each lane.
        now: the episode under way in each lane.
        action: multi-discrete, one entry per binding (`levelgen.task.actions`).
        params: rules of the task.
    """
    after, result = advance(level, now, action, params)
    return restart(level, after, result.done), result
