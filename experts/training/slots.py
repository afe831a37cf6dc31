"""The state of continuous batching: slots, each with an expert in training or under evaluation, and the queue.

`experts.training.advance` says how it changes.
"""

from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.policy import Constant, network_of
from levelproof.experts.training import ppo, progress, stop
from levelproof.experts.training.ppo import TrainState
from levelproof.experts.training.progress import Progress
from levelproof.experts.training.rollout import Acting, start
from levelproof.experts.training.stop import Course
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import CHOICES


class Mode(IntEnum):
    EMPTY = 0
    TRAIN = 1
    EVALUATE = 2


class Training(NamedTuple):
    """An expert and what its training has shown."""

    train_state: TrainState
    progress: Progress
    course: Course
    success: Success  # the first: the search's, else training's
    recent: Int[Array, "time 6 environment"]  # the last actions, enough for an episode that ends in the next rollout


class Begun(NamedTuple):
    """All that decides how training goes on."""

    training: Training
    acting: Acting  # [..., environment]


class Pending(NamedTuple):
    """What comes next for an expert, beside what its course says."""

    due: Bool[Array, ""] | Bool[np.ndarray, " index"] | np.bool_  # an evaluation, by what training showed
    final: Bool[Array, ""] | Bool[np.ndarray, " index"] | np.bool_  # one after which the level leaves
    deadline: Int[Array, ""] | Int[np.ndarray, " index"] | np.int32  # updates after which the last evaluation comes


class Trial(NamedTuple):
    """An evaluation: every environment rolls out a record."""

    part: Int[Array, ""]  # rollouts of it that are done
    due: Bool[Array, ""]  # by what training showed
    final: Bool[Array, ""]  # the level leaves afterwards
    solved: Bool[Array, ""]  # it has ended, and enough attempts succeeded
    action: Int[Array, "time 6 attempt"]
    done: Bool[Array, "time environment"]
    goal: Bool[Array, "time environment"]


class Slot(NamedTuple):
    """One slot. In `Slots` every array has the slots first."""

    mode: Int[Array, ""]
    queue_index: Int[Array, ""]  # of the level in the queue
    deadline: Int[Array, ""]  # updates after which the last evaluation comes
    training: Training
    trial: Trial


class Slots(NamedTuple):
    """All of them."""

    slot: Slot
    acting: Acting  # of training; lanes, slot by slot
    trial: Acting  # of evaluation
    taken: Int[Array, ""]  # levels that have left the queue, ever


class LevelQueue(NamedTuple):
    """Levels that wait, and those in slots: each keeps its index, which is any, until it leaves its slot."""

    levels: Level  # [..., index]
    level_ids: Int[Array, " index"] | Int[np.ndarray, " index"]
    order: Int[Array, " number"] | Int[np.ndarray, " number"]  # indices of levels, as they came, modulo capacity
    come: Int[Array, ""] | np.int32  # levels that have come, ever
    begun: Begun  # where their experts go on, index first
    pending: Pending  # index first

    @property
    def capacity(self) -> int:
        return len(self.level_ids)


class Report(NamedTuple):
    """What one call of `advance` did in each slot."""

    queue_index: Int[Array, " slot"]  # of the level in the queue
    mode: Int[Array, " slot"]  # while it did
    share: Float[Array, " slot"]  # of a trained slot's finished episodes that reached the goal
    evaluated: Bool[Array, " slot"]  # an evaluation ended that solved the level, or after which it left
    left: Bool[Array, " slot"]
    early: Bool[Array, " slot"]  # it left, being solved, and might have trained on
    taken: Int[Array, ""]  # levels that have left the queue, ever


@partial(jax.jit, static_argnames="config")
def begin(levels: Level, level_ids: Int[Array, " level"], success: Success, config: ExpertConfig) -> Begun:
    """Experts that have seen nothing but a success, where there is one; level axis first."""
    network, lanes = network_of(levels.size, config), config.environments

    def training(level_id, constant: Constant, success: Success) -> Training:
        key = jax.random.fold_in(key_for(level_id, Stream.EXPERT), 0)
        train_state = ppo.init(key, network, constant, config)
        recent = jnp.zeros((RECORD_STEPS, len(CHOICES), lanes), jnp.int8)
        return Training(train_state, progress.start(lanes), stop.begin(), success, recent)

    experts = jax.vmap(training, in_axes=(0, -1, 0))(level_ids, network.constant(levels), success)
    return Begun(experts, _by_slot(start(repeat(levels, lanes)), lanes))


@partial(jax.jit, static_argnames=("count", "config"))
def empty_slots(count: int, queue: LevelQueue, config: ExpertConfig) -> Slots:
    """Slots without levels."""
    blank = lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype)
    training, acting = jax.tree.map(blank, queue.begun)
    rows, zeros, no = config.record_rollouts * config.horizon, jnp.zeros(count, jnp.int32), jnp.zeros(count, bool)
    action = jnp.zeros((count, rows, len(CHOICES), config.attempts), jnp.int8)
    trial = Trial(zeros, no, no, no, action, *jnp.zeros((2, count, rows, config.environments), bool))
    acting = lanes_of(acting)
    return Slots(Slot(zeros, zeros, zeros, training, trial), acting, acting, jnp.int32(0))


def lanes_of(tree: Any) -> Any:
    """[slot, ..., environment] -> [..., lane]."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], x.shape[0] * x.shape[-1]), tree)


def _by_slot(tree: Any, environments: int) -> Any:
    """[..., lane] -> [slot, ..., environment]."""
    apart = lambda x: x.reshape(*x.shape[:-1], x.shape[-1] // environments, environments)
    return jax.tree.map(lambda x: jnp.moveaxis(apart(x), -2, 0), tree)
