"""Rollouts of experts in their levels: `levels x environments` lanes, level by level.

Lane `i * environments + j` is environment j of level i.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.policy import ActorCritic, forward, log_probability, most_probable, sample
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, action_mask
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.rules import TaskParams, TaskState


class Acting(NamedTuple):
    """Unfinished episodes."""

    world: TaskState
    last_action: Int[Array, "6 lane"]  # last action of this episode; 0 at its start


class ActionRule(NamedTuple):
    """How lanes choose actions, if not by sampling."""

    greedy: Bool[Array, " lane"]  # take the most probable action
    stickiness: Float[Array, " lane"]  # probability of repeating the last action
    rehearsing: Bool[Array, " lane"]  # take the action of `rehearsal` at the episode's env step
    rehearsal: Int[Array, "256 6 level"]

    @staticmethod
    def sampling(lanes: int, levels: int) -> "ActionRule":
        """Return the rule by which every lane samples."""
        no = jnp.zeros(lanes, bool)
        return ActionRule(no, jnp.zeros(lanes), no, jnp.zeros((1, len(CHOICES), levels), jnp.int8))

    @property
    def own(self) -> Bool[Array, " lane"]:
        """Whether the expert alone chooses every action of the lane."""
        return ~self.rehearsing & (self.stickiness == 0)


class Trajectory(NamedTuple):
    """Data of a rollout, time first."""

    moving: Float[Array, "time dynamic level environment"]  # moving features of the observation before the action
    action: Int[Array, "time 6 level environment"]
    log_probability: Float[Array, "time level environment"]
    value: Float[Array, "time level environment"]
    reward: Float[Array, "time level environment"]
    done: Bool[Array, "time level environment"]
    goal: Bool[Array, "time level environment"]
    timestep: Int[Array, "time level environment"]  # env steps of the episode before this step


def start(lanes: Level) -> Acting:
    """Start an episode in every lane."""
    world = task.reset(lanes)
    return Acting(world, jnp.zeros((len(CHOICES), *world.timestep.shape), jnp.int32))


def rollout(
    network: ActorCritic,
    params,
    levels: Level,
    acting: Acting,
    keys: Key[Array, " level"],
    manner: ActionRule,
    steps: int,
    rules: TaskParams,
) -> tuple[Acting, Trajectory, Float[Array, "level environment"]]:
    """Act for `steps` env steps, with automatic reset.

    Args:
        network: the shape of the experts' networks.
        params: parameters of every expert, level axis first.
        levels: one level per expert.
        acting: unfinished episodes, one per lane.
        keys: one per expert; consumed.
        manner: how actions are chosen.
        steps: env steps in each lane.
        rules: the task's rules.

    Returns:
        The unfinished episodes, the trajectory, and the value of the last observation.
    """
    level_count = keys.shape[0]
    environments = len(manner.greedy) // level_count
    level_of = jnp.arange(len(manner.greedy)) // environments
    lanes = repeat(levels, environments)
    constant, live = network.constant(levels), action_mask(lanes)
    per_level = lambda x: x.reshape(*x.shape[:-1], level_count, environments)
    flat = lambda x: x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])
    each = jax.vmap(partial(forward, network), in_axes=(0, -1, 1), out_axes=(-2, 0))

    def look(world: TaskState):
        moving = per_level(state_features(lanes, world.state))
        logits, value = each(params, constant, moving)
        return moving, flat(logits), value

    def draw(key, t):
        return jax.random.uniform(jax.random.fold_in(key, t), (len(CHOICES) + 1, environments))

    def act(acting: Acting, t):
        world, last = acting
        moving, logits, value = look(world)
        uniform = flat(jnp.moveaxis(jax.vmap(draw, in_axes=(0, None))(keys, t), 0, 1))
        action = jnp.where(manner.greedy, most_probable(logits), sample(logits, uniform[:-1]))
        action = jnp.where(uniform[-1] < manner.stickiness, last, action)
        rehearsed = manner.rehearsal[world.timestep, :, level_of].T.astype(jnp.int32)
        action = jnp.where(manner.rehearsing, rehearsed, action)
        action = jnp.where(live, action, 0)
        log_probs = log_probability(logits, action, live)
        after, outcome = task.step(lanes, world, action, rules)
        played, log_probs, reward, done, goal, timestep = map(per_level, (action, log_probs, *outcome, world.timestep))
        trajectory = Trajectory(moving, played, log_probs, value, reward, done, goal, timestep)
        return Acting(after, jnp.where(outcome.done, 0, action)), trajectory

    acting, trajectory = jax.lax.scan(act, acting, jnp.arange(steps))
    return acting, trajectory, look(acting.world)[2]
