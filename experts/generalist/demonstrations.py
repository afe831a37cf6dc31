"""Demonstrations: what experts choose in episodes with noise (DART, Laskey et al. 2017, arXiv:1703.09327).

A witness shows one way to the goal and no mistake. Here the level's expert plays again, while its last action sometimes
replaces the one it chooses, or bodies start with other velocities. So it leaves its way, and shows how it returns: what
is learned in a state is the action that it chose there, executed or not.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Key

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.evaluation import Moment
from levelproof.experts.generalist.teachers import KnownExperts, Labels, Teacher, play_expert
from levelproof.experts.imitation import to_motion
from levelproof.experts.noise import PERTURBATION, STICKINESS, pushed
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import TaskParams, TaskState

AT_ONCE = 128  # episodes that are played side by side


class Demonstrations(NamedTuple):
    """First episodes of experts."""

    length: Int[Array, " episode"]  # env steps to the goal; 0: it was not reached
    action: Int8[Array, "256 6 episode"]  # that the expert chose; meaningless after `length`
    motion: Float[Array, "256 episode column"]  # before each action (`experts.imitation.Transitions`)
    env_steps: Int[Array, " episode"]  # until the episode's end


class _Demonstrating(NamedTuple):
    now: TaskState
    executed: Int[Array, "6 episode"]
    ended: Bool[Array, " episode"]


@partial(jax.jit, static_argnames=("config", "contacts", "rules"))
def demonstrate(
    params: Any,
    level: Level,
    keys: Key[Array, " episode"],
    sticky: Bool[Array, " episode"],
    perturbed: Bool[Array, " episode"],
    config: ExpertConfig,
    contacts: bool,
    rules: TaskParams,
) -> Demonstrations:
    """Play an episode of each expert in its own level, with sampled actions.

    Args:
        params: parameters of the experts, episode axis first.
        level: their levels, with first states.
        keys: one per episode; consumed.
        sticky: whether the last action replaces the expert's with probability STICKINESS.
        perturbed: whether the velocities at the start are changed, each by at most PERTURBATION.
        config: settings of the experts.
        contacts: whether to return contacts, too.
        rules: the task's rules.
    """
    live, player = action_mask(level), play_expert(config)
    draw = lambda number, shape: jax.vmap(
        lambda key: jax.random.uniform(jax.random.fold_in(key, number), shape), out_axes=-1
    )(keys)

    def act(playing: _Demonstrating, step: Array) -> tuple[_Demonstrating, tuple[Array, ...]]:
        now, executed, ended = playing
        uniform = draw(step, (ACTIONS + 1,))
        chosen = jnp.where(live, player(params, Moment(level, now, executed, uniform[:-1])), 0)
        sticks = sticky & (step > 0) & (uniform[-1] < STICKINESS)
        executed = jnp.where(sticks, executed, chosen)
        after, result = task.advance(level, now, executed, rules)
        told = chosen.astype(jnp.int8), to_motion(now.state, contacts), result.goal & ~ended, ~ended
        return _Demonstrating(after, executed, ended | result.done), told

    world = task.reset(level)
    change = (2 * draw(RECORD_STEPS, (3, len(level.model.active))) - 1) * PERTURBATION
    world = replace(world, state=pushed(level, world.state, jnp.where(perturbed, change, 0.0)))
    begun = _Demonstrating(world, jnp.zeros_like(live, jnp.int32), jnp.zeros(len(keys), bool))
    _, (action, motion, goal, played) = jax.lax.scan(act, begun, jnp.arange(RECORD_STEPS))
    length = jnp.where(goal.any(0), jnp.argmax(goal, 0) + 1, 0)
    return Demonstrations(length, action, motion, played.sum(0))


def demonstrations(
    levels: Level,
    known: KnownExperts,
    sticky: float,
    perturbed: float,
    contacts: bool,
    key: Key[Array, ""],
    rules: TaskParams,
) -> Labels:
    """Return noisy episodes of experts as labels of the levels' first states.

    Args:
        levels: the levels, on the host, level axis last.
        known: their experts; every level has one.
        sticky: share of the episodes with sticky actions.
        perturbed: share of the episodes with perturbed velocities, drawn independently.
        contacts: whether the network reads contacts.
        key: consumed.
        rules: the task's rules.
    """
    assert known.config is not None
    count = len(known.expert)
    keys = jax.random.split(key, count + 1)
    noisy = jax.device_get(jax.random.uniform(keys[-1], (2, count))) < np.array([[sticky], [perturbed]])
    parts = []
    for some in blocks(count, AT_ONCE):
        params = jax.tree.map(lambda x, some=some: x[known.expert[some]], known.params)
        of_block = params, take(levels, some), keys[some], *noisy[:, some]
        parts.append(jax.device_get(demonstrate(*of_block, known.config, contacts, rules)))
    join = lambda name, axis: np.concatenate([getattr(each, name) for each in parts], axis)
    length = join("length", 0)[:count]
    teacher = np.where(length > 0, Teacher.EXPERT, Teacher.NONE)
    env_steps = int(join("env_steps", 0)[:count].sum())
    return Labels(teacher, length, join("action", -1)[..., :count], join("motion", 1)[:, :count], env_steps)
