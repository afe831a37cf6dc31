"""Demonstrations: what experts choose in episodes with noise (DART, Laskey et al. 2017, arXiv:1703.09327).

A witness shows one way to the goal and no mistake. Here the level's expert plays again, while the action executed last
sometimes replaces the one it chooses, or bodies start with other velocities. So it leaves its path, and shows how it
returns: what is learned in a state is the action that it chose there, executed or not. The strength of the noise is
fixed; DART fits it to the learner's errors.
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
from levelproof.experts.generalist.attempts import play_expert
from levelproof.experts.generalist.teachers import KnownExperts, Labels, Teacher
from levelproof.experts.imitation import to_motion
from levelproof.experts.noise import PERTURBATION, STICKINESS, pushed
from levelproof.levelgen.batching import BATCHES, block_size, blocks, take
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import TaskParams, TaskState


class Demonstrations(NamedTuple):
    """First episodes of experts."""

    length: Int[Array, " episode"]  # env steps to the goal; 0: it was not reached
    action: Int8[Array, "256 6 episode"]  # that the expert chose; meaningless after `length`
    motion: Float[Array, "256 episode column"]  # before each action (`experts.imitation.Transitions`)
    env_steps: Int[Array, " episode"]  # until the episode's end


class _Demonstrating(NamedTuple):
    """Episodes under way; a step's action and motion are written before it."""

    step: Int[Array, ""]
    now: TaskState
    executed: Int[Array, "6 episode"]
    ended: Bool[Array, " episode"]
    shown: Demonstrations


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
        sticky: whether the action executed last replaces the expert's choice with probability STICKINESS.
        perturbed: whether the velocities at the start are changed, each by at most PERTURBATION.
        config: settings of the experts.
        contacts: whether to return contacts, too.
        rules: the task's rules.
    """
    live, player, count = action_mask(level), play_expert(config), len(keys)
    draw = lambda number, shape: jax.vmap(
        lambda key: jax.random.uniform(jax.random.fold_in(key, number), shape), out_axes=-1
    )(keys)

    def act(playing: _Demonstrating) -> _Demonstrating:
        step, now, executed, ended, shown = playing
        uniform = draw(step, (ACTIONS + 1,))
        chosen = jnp.where(live, player(params, Moment(level, now, executed, uniform[:-1])), 0)
        sticks = sticky & (step > 0) & (uniform[-1] < STICKINESS)
        executed = jnp.where(sticks, executed, chosen)
        after, result = task.advance(level, now, executed, rules)
        write = lambda whole, part: jax.lax.dynamic_update_index_in_dim(whole, part.astype(whole.dtype), step, 0)
        shown = Demonstrations(
            jnp.where(result.goal & ~ended, step + 1, shown.length),
            write(shown.action, chosen),
            write(shown.motion, to_motion(now.state, contacts)),
            shown.env_steps + ~ended,
        )
        return _Demonstrating(step + 1, after, executed, ended | result.done, shown)

    world = task.reset(level)
    change = (2 * draw(RECORD_STEPS, (3, len(level.model.active))) - 1) * PERTURBATION
    world = replace(world, state=pushed(level, world.state, jnp.where(perturbed, change, 0.0)))
    none, columns = jnp.zeros(count, jnp.int32), to_motion(world.state, contacts).shape[1]
    taken = jnp.zeros((RECORD_STEPS, ACTIONS, count), jnp.int8)
    shown = Demonstrations(none, taken, jnp.zeros((RECORD_STEPS, count, columns)), none)
    begun = _Demonstrating(jnp.int32(0), world, jnp.zeros_like(live, jnp.int32), jnp.zeros(count, bool), shown)
    going = lambda playing: ~playing.ended.all() & (playing.step < RECORD_STEPS)
    return jax.lax.while_loop(going, act, begun).shown


def demonstrations(
    levels: Level,
    known: KnownExperts,
    sticky: float,
    perturbed: float,
    contacts: bool,
    key: Key[Array, ""],
    rules: TaskParams,
) -> Labels:
    """Return episodes of experts, some with noise, as labels of the levels' first states.

    Args:
        levels: the levels, on the host, level axis last; all are played at once.
        known: their experts; every level has one.
        sticky: share of the episodes with sticky actions.
        perturbed: share of the episodes with perturbed velocities, drawn independently.
        contacts: whether the network reads contacts.
        key: consumed.
        rules: the task's rules.
    """
    assert known.config is not None
    assert (known.expert >= 0).all()
    count = len(known.expert)
    (some,) = blocks(count, block_size(count, max(count, BATCHES[-1])))  # padded: a program for each of a few sizes
    keys = jax.random.split(key, count + 1)
    noisy = jax.device_get(jax.random.uniform(keys[-1], (2, count))) < np.array([[sticky], [perturbed]])
    params = jax.tree.map(lambda x: x[known.expert[some]], known.params)
    one: Any = jax.device_get(
        demonstrate(params, take(levels, some), keys[some], *noisy[:, some], known.config, contacts, rules)
    )
    length = one.length[:count]
    teacher = np.where(length > 0, Teacher.EXPERT, Teacher.NONE)
    return Labels(teacher, length, one.action[..., :count], one.motion[:, :count], int(one.env_steps[:count].sum()))
