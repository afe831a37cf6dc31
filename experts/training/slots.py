"""Slots, each training or evaluating an expert; `experts.training.advance` advances them."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.labels import Cause
from levelproof.experts.policy import Constant, network_of
from levelproof.experts.training import ppo, progress, stop
from levelproof.experts.training.ppo import TrainState
from levelproof.experts.training.progress import Progress
from levelproof.experts.training.rollout import Acting, start
from levelproof.experts.training.stop import StopState
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat, split_lanes
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_quickly, jit_sooner
from levelproof.levelgen.task.actions import CHOICES


class Mode(IntEnum):
    """State of a slot in a call of `advance`.

               over, or paused during an evaluation
            .------------------------------------------.
            |                                          v      next part
        +-------+  a level   +-------+ due, final +----------+ of the record
        | EMPTY |----------->| TRAIN |----------->| EVALUATE |----.
        +-------+  enters    +-------+            +----------+ <--'
            ^                    ^                     |  |
            |                    `---------------------'  |
            |           not solved, or solved and polish  |
            `---------------------------------------------'
                       final, or solved without polish

    due: enough finished episodes of an update reached the goal (`stop.after_update`).
    over: training has stopped for good (`labels.Cause`).
    final: the expert is over or its budget is spent, so the level leaves after this evaluation.
    polish: `StopConfig.polish`, training after a level is solved.

    Some levels that leave before a final evaluation (`Report.early`) were solved by witnesses that few replays
    survive: the host sets their slots back to TRAIN before the next call (`advance.train_on`).
    """

    EMPTY = 0
    TRAIN = 1
    EVALUATE = 2


class Training(NamedTuple):
    """An expert, and the results of its training so far."""

    train_state: TrainState
    progress: Progress
    course: StopState
    success: Success  # the first, of the search or of training
    recent: Int[Array, "time 6 environment"]  # last actions, enough for an episode that ends in the next rollout


class ExpertState(NamedTuple):
    """An expert with all that decides how its training continues."""

    training: Training
    acting: Acting  # [..., environment]


class Pending(NamedTuple):
    """Next steps of an expert, besides its `StopState`."""

    due: Bool[Array, ""] | Bool[np.ndarray, " index"] | np.bool_  # an evaluation, triggered by training
    final: Bool[Array, ""] | Bool[np.ndarray, " index"] | np.bool_  # an evaluation, after which the level leaves
    deadline: Int[Array, ""] | Int[np.ndarray, " index"] | np.int32  # updates before the final evaluation


class EvaluationState(NamedTuple):
    """An unfinished evaluation: every environment rolls out a record."""

    part: Int[Array, ""]  # rollouts done
    due: Bool[Array, ""]  # training triggered it
    final: Bool[Array, ""]  # the level leaves afterwards
    solved: Bool[Array, ""]  # the evaluation has ended with enough successes
    action: Int[Array, "time 6 attempt"]
    done: Bool[Array, "time environment"]
    goal: Bool[Array, "time environment"]


class Slot(NamedTuple):
    """One slot, without its lanes. In `Slots` every array has the slot axis first."""

    mode: Int[Array, ""]
    deadline: Int[Array, ""]  # updates before the final evaluation
    training: Training
    trial: EvaluationState


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Slots:
    """All slots, slot axis first, except in `levels`; a slot of zeros is empty."""

    levels: Level  # slot axis last
    level_ids: Int[Array, " slot"]
    slot: Slot
    acting: Acting  # of training, [slot, ..., environment]
    trial: Acting  # of evaluation


class Report(NamedTuple):
    """Report of one call of `advance`, by slot."""

    mode: Int[Array, " slot"]  # during the call
    share: Float[Array, " slot"]  # share of a training slot's finished episodes that reached the goal
    evaluated: Bool[Array, " slot"]  # an evaluation ended and solved the level, or the level left
    left: Bool[Array, " slot"]
    early: Bool[Array, " slot"]  # the level left solved, before its final evaluation


@jit_sooner(static_argnames="config")
def begin(levels: Level, level_ids: Int[Array, " level"], success: Success, config: ExpertConfig) -> ExpertState:
    """Initialise experts, level axis first; they know nothing but the success, if there is one."""
    network, lanes = network_of(levels.size, config), config.environments

    def training(level_id, constant: Constant, success: Success) -> Training:
        key = jax.random.fold_in(key_for(level_id, Stream.EXPERT), 0)
        train_state = ppo.init(key, network, constant, config)
        recent = jnp.zeros((RECORD_STEPS, len(CHOICES), lanes), jnp.int8)
        return Training(train_state, progress.start(lanes), stop.begin(), success, recent)

    experts = jax.vmap(training, in_axes=(0, -1, 0))(level_ids, network.constant(levels), success)
    return ExpertState(experts, split_lanes(start(repeat(levels, lanes)), lanes))


@jit_quickly(static_argnames="config")
def slots_of(
    levels: Level, level_ids: Int[Array, " level"], experts: ExpertState, pending: Pending, config: ExpertConfig
) -> Slots:
    """Return slots in which these experts continue, level axis first.

    An expert whose training has stopped for good is only evaluated; so is one that was paused during an evaluation.
    """
    count, rows = len(level_ids), config.record_rollouts * config.horizon
    due, final, deadline = map(jnp.asarray, pending)
    final |= (experts.training.course.over != Cause.NONE) | (experts.training.course.updates >= deadline)
    mode = jnp.where(due | final, jnp.int32(Mode.EVALUATE), jnp.int32(Mode.TRAIN))
    action = jnp.zeros((count, rows, len(CHOICES), config.attempts), jnp.int8)
    done, goal = jnp.zeros((2, count, rows, config.environments), bool)
    trial = EvaluationState(jnp.zeros_like(mode), due, final, jnp.zeros_like(final), action, done, goal)
    slot = Slot(mode, deadline, experts.training, trial)
    return Slots(levels, level_ids, slot, experts.acting, experts.acting)
