"""Continuous batching: a fixed number of slots, each training or evaluating an expert.

One compiled program, `advance`, advances every slot by a rollout. A level's result depends on the level, its id and the
configuration alone: not on its slot, its neighbours or its time of entry. `slots.Mode` has a diagram of the states of a
slot.

An evaluation interrupts the training of its slot and leaves no trace in it.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.config import ExpertConfig
from levelproof.experts.noise import PERTURBATION, STICKINESS, pushed
from levelproof.experts.objective import advantages
from levelproof.experts.policy import ActorCritic, network_of
from levelproof.experts.training import ppo, progress, stop
from levelproof.experts.training.ppo import LevelConstants, Samples
from levelproof.experts.training.rollout import Acting, ActionRule, Trajectory, rollout, start
from levelproof.experts.training.slots import EvaluationState, Mode, Report, Slot, Slots, Training
from levelproof.experts.training.stop import StopRules
from levelproof.experts.witness.success import find, remember
from levelproof.levelgen.batching import merge_lanes, repeat, split_lanes
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_stored
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import TaskParams


def over_slots(function: Callable, *slots: Any) -> Any:
    """Map over slots; on a CPU one after another, so that a minibatch stays in cache and `cond` skips branches."""
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda xs: function(*xs), slots)
    return jax.vmap(function)(*slots)


@jit_stored(static_argnames=("config", "rules"), donate_argnames="slots")
def advance(slots: Slots, config: ExpertConfig, stopping: StopRules, rules: TaskParams) -> tuple[Slots, Report]:
    """Roll out every slot, then update its expert or record a part of its evaluation.

    Args:
        slots: state of every slot; donated.
        config: settings of an expert.
        stopping: rules that say when a level leaves.
        rules: the task's rules, with the reward that experts train on.
    """
    slot, levels = slots.slot, slots.levels
    keys = jax.vmap(_key)(slots.level_ids, slot)
    lanes = repeat(levels, config.environments)
    evaluating = slot.mode == Mode.EVALUATE

    trains = repeat(~evaluating, config.environments)
    fresh = repeat(slot.trial.part == 0, config.environments)
    training, trial = merge_lanes(slots.acting), merge_lanes(slots.trial)
    acting = _where(trains, training, _where(fresh, _perturbed_start(lanes, keys, config), trial))

    network = network_of(levels.size, config)
    manner = _manner(slot, evaluating, config)
    acting, trajectory, last_value = rollout(
        network, slot.training.train_state.params, levels, acting, keys, manner, config.horizon, rules
    )
    now = _split(network, levels, keys, trajectory, last_value, manner, config)
    slot, share, mode = over_slots(partial(_follow, network=network, config=config, stopping=stopping), slot, now)
    left = (slot.mode == Mode.EMPTY) & (mode == Mode.EVALUATE)
    evaluated = (mode == Mode.EVALUATE) & (left | slot.trial.solved)
    training, trial = (split_lanes(lanes, config.environments) for lanes in (_where(trains, acting, training), acting))
    early = left & slot.trial.solved & ~slot.trial.final
    after = replace(slots, slot=slot, acting=training, trial=trial)
    return after, Report(mode, share, evaluated, left, early)


@partial(jax.jit, donate_argnames="slots")
def train_on(slots: Slots, stays: Bool[Array, " slot"], stopping: StopRules) -> Slots:
    """Resume training in slots marked in `stays`, for a witness that more replays survive; donates `slots`."""
    slot = slots.slot
    course, deadline = stop.train_on(slot.training.course, slot.deadline, stopping)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(stays, a, b), new, old)
    slot = slot._replace(
        mode=keep(jnp.full_like(slot.mode, Mode.TRAIN), slot.mode),
        deadline=keep(deadline, slot.deadline),
        training=slot.training._replace(course=keep(course, slot.training.course)),
    )
    return replace(slots, slot=slot)


class _RolloutData(NamedTuple):
    """Data of one slot's rollout."""

    constants: LevelConstants
    key: Key[Array, ""]
    rows: Float[Array, "sample column"]
    action: Int[Array, "time 6 environment"]
    reward: Float[Array, "time environment"]
    done: Bool[Array, "time environment"]
    goal: Bool[Array, "time environment"]
    timestep: Int[Array, "time environment"]
    own: Bool[Array, " environment"]  # as `ActionRule.own`


def sample_rows(
    trajectory: Trajectory,
    last_value: Float[Array, "slot environment"],
    rehearsing: Bool[Array, " lane"],
    config: ExpertConfig,
) -> Float[Array, "slot sample column"]:
    """Compute advantages; return the samples of every slot as `ppo.as_rows` lays them out, slots first."""
    advantage = advantages(
        trajectory.value, trajectory.reward, trajectory.done, last_value, config.discount, config.gae_lambda
    )
    rehearsed = jnp.broadcast_to(rehearsing.reshape(trajectory.value.shape[1:]), trajectory.value.shape)
    samples = Samples(
        trajectory.moving,
        trajectory.action,
        trajectory.log_probability,
        trajectory.value,
        advantage,
        rehearsed.astype(jnp.float32),
    )
    return jax.vmap(ppo.as_rows, in_axes=-2)(samples)


def _split(
    network: ActorCritic,
    levels: Level,
    keys: Key[Array, " slot"],
    trajectory: Trajectory,
    last_value: Float[Array, "slot environment"],
    manner: ActionRule,
    config: ExpertConfig,
) -> _RolloutData:
    """Split a rollout by slot, slots first."""
    action, reward, done, goal, timestep = jax.tree.map(
        lambda x: jnp.moveaxis(x, -2, 0),
        (trajectory.action.astype(jnp.int8), trajectory.reward, trajectory.done, trajectory.goal, trajectory.timestep),
    )
    return _RolloutData(
        jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), LevelConstants(network.constant(levels), action_mask(levels))),
        keys,
        sample_rows(trajectory, last_value, manner.rehearsing, config),
        action,
        reward,
        done,
        goal,
        timestep,
        manner.own.reshape(-1, config.environments),
    )


def _follow(
    slot: Slot, now: _RolloutData, network: ActorCritic, config: ExpertConfig, stopping: StopRules
) -> tuple[Slot, Float[Array, ""], Int[Array, ""]]:
    """Process a slot's rollout; return the slot, its share of successes, and the mode it was in."""
    nothing = jnp.float32(jnp.nan)
    branches = (
        lambda: (slot, nothing),
        lambda: _learn(slot, now, network, config, stopping),
        lambda: (_collect(slot, now, config, stopping), nothing),
    )
    after, share = jax.lax.switch(slot.mode, branches)
    return after, share, slot.mode


def _learn(
    slot: Slot, now: _RolloutData, network: ActorCritic, config: ExpertConfig, stopping: StopRules
) -> tuple[Slot, Float[Array, ""]]:
    """Update the expert, and decide whether an evaluation comes next."""
    training = slot.training
    totals, share = progress.follow(training.progress, now.reward, now.done, now.goal, now.own)
    recent = jnp.concatenate([training.recent, now.action])
    success = remember(training.success, find(recent, now.goal, now.timestep))
    shuffling = jax.random.fold_in(now.key, config.horizon)  # the rollout used 0 .. horizon - 1
    train_state = ppo.update(training.train_state, shuffling, network, now.constants, now.rows, config)
    totals = progress.watch(totals, train_state.params)
    course, due, final = stop.after_update(training.course, totals, success.length > 0, share, slot.deadline, stopping)
    training = Training(train_state, totals, course, success, recent[config.horizon :])
    trial = slot.trial._replace(part=jnp.int32(0), due=due, final=final)
    return slot._replace(mode=jnp.where(due | final, Mode.EVALUATE, Mode.TRAIN), training=training, trial=trial), share


def _collect(slot: Slot, now: _RolloutData, config: ExpertConfig, stopping: StopRules) -> Slot:
    """Record a part of an evaluation; after the last part, decide whether the level leaves."""
    first = slot.trial.part * config.horizon
    put = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, first, 0)
    action = put(slot.trial.action, now.action[..., : config.attempts])
    done, goal = put(slot.trial.done, now.done), put(slot.trial.goal, now.goal)
    part = slot.trial.part + 1
    hopeless = ~slot.trial.final & stop.fails(done, goal, part * config.horizon, stopping, config)
    ended = (part == config.record_rollouts) | hopeless
    solved = ended & ~hopeless & stop.solves(done, goal, stopping, config)
    trial = EvaluationState(part, slot.trial.due, slot.trial.final, solved, action, done, goal)
    course, leaves, deadline = stop.after_evaluation(
        slot.training.course, solved, trial.due, trial.final, slot.deadline, stopping
    )
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(ended, a, b), new, old)
    mode = jnp.where(leaves, Mode.EMPTY, Mode.TRAIN)
    training = slot.training._replace(course=keep(course, slot.training.course))
    return Slot(keep(mode, slot.mode), keep(deadline, slot.deadline), training, trial)


def _key(level_id: Int[Array, ""], slot: Slot) -> Key[Array, ""]:
    """Derive the key of a slot's next rollout."""
    update = slot.training.course.updates
    learning = jax.random.fold_in(key_for(level_id, Stream.EXPERT), update + 1)
    evaluation = jax.random.fold_in(jax.random.fold_in(key_for(level_id, Stream.EVALUATION), update), slot.trial.part)
    return jnp.where(slot.mode == Mode.EVALUATE, evaluation, learning)


def _manner(slot: Slot, evaluating: Bool[Array, " slot"], config: ExpertConfig) -> ActionRule:
    """Choose how each lane acts.

    Evaluation: plain attempts first, then sticky and perturbed ones. Training: rehearsals in the last environments.
    """
    number = jnp.arange(config.environments)
    sticky = (number >= config.attempts) & (number < config.attempts + config.sticky_attempts)
    succeeded = slot.training.success.length > 0
    guides = number >= config.environments - config.rehearsals
    per_lane = lambda slots, environments: (slots[:, None] & environments).reshape(-1)
    stickiness = STICKINESS * per_lane(evaluating, sticky) + config.persistence * per_lane(
        ~evaluating & ~succeeded, guides
    )
    return ActionRule(
        per_lane(evaluating, number == 0),
        stickiness,
        per_lane(~evaluating & succeeded, guides),
        jnp.moveaxis(slot.training.success.action, 0, -1),
    )


def _perturbed_start(lanes: Level, keys: Key[Array, " slot"], config: ExpertConfig) -> Acting:
    """Reset each lane to its level's first state, with changed velocities in perturbed attempts."""
    number = jnp.arange(config.environments)
    first = config.attempts + config.sticky_attempts
    perturbed = jnp.tile((number >= first) & (number < first + config.perturbed_attempts), len(keys))
    acting = start(lanes)

    def noise(key):
        shape = (3, len(lanes.model.active), config.environments)
        return jax.random.uniform(
            jax.random.fold_in(key, config.horizon), shape, minval=-PERTURBATION, maxval=PERTURBATION
        )

    drawn = jnp.moveaxis(jax.vmap(noise)(keys), 0, -2).reshape(3, len(lanes.model.active), -1)
    state = pushed(lanes, acting.world.state, jnp.where(perturbed, drawn, 0.0))
    return acting._replace(world=replace(acting.world, state=state))


def _where(lanes: Bool[Array, " lane"], a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(lanes, x, y), a, b)
