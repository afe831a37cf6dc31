"""Training: slots of experts side by side, each with its budget, then evaluation, witnesses and verdicts.

Levels that need no expert (`experts.before`) get none, and use nothing of their budget.

An expert's result depends on its level, its level id and the configuration alone: every slot has its own random
streams, and the program always has the same number of slots, filled up with repetitions where levels are few.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from experts import ppo, progress
from experts.before import decide
from experts.config import ExpertConfig
from experts.labels import WITNESSED, Label, Verdict, solved_reason, unsolved_reason
from experts.policy import ActorCritic
from experts.ppo import Batch, Expert
from experts.progress import NEVER, Progress
from experts.rollout import Experience, repeat, rollout
from experts.witness import RECORD_STEPS, Record, replay, steps_to_goal, succeeds, take
from levelgen import task
from levelgen.identity import Stream, key_for
from levelgen.level import Level
from levelgen.observe import dynamic_features, feature_count, level_features
from levelgen.task import DEFAULT_RULES, TaskParams, TaskState

LANES_IN_CACHE = 128  # their physics and one minibatch fit the cache of a core
LANES_ON_ACCELERATOR = 32_768

Report = Callable[[int, int], None]  # (env steps so far, levels solved so far)


@dataclass(frozen=True)
class UnitResult:
    """What came of some levels, on the host, in the order they were given."""

    level_ids: np.ndarray  # int64
    levels: Level
    record: Record  # all zero where the level has no witness
    verdicts: list[Verdict]


class Slots(NamedTuple):
    """Everything that changes while experts train."""

    experts: Expert  # level axis first
    world: TaskState  # lanes: levels x environments
    progress: Progress


def train_levels(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    config: ExpertConfig,
    rules: TaskParams = DEFAULT_RULES,
    report: Report = lambda env_steps, solved: None,
) -> UnitResult:
    """Label the levels; train an expert for each that needs one.

    Args:
        levels: the levels, as their ids rebuild them.
        level_ids: their ids; the seeds of all randomness.
        budget: env steps that each expert may use.
        config: what an expert is.
        rules: of the task; records hold its rewards, training shapes with the configuration's.
        report: called now and then with totals over all experts.

    Raises:
        ValueError: the budget does not suffice for one update.
    """
    updates = updates_in(budget, config)
    level_ids = np.asarray(level_ids)
    levels = jax.tree.map(np.asarray, levels)
    verdicts, failed = decide(levels, rules)
    left = np.array([i for i, verdict in enumerate(verdicts) if verdict is None], int)
    actions = np.zeros((RECORD_STEPS, 6, len(level_ids)), np.int32)  # doing nothing, where none are found
    solved = 0
    for first, places in _batches(len(left), slot_count(config)):
        index = left[places]
        kept = len(np.unique(index))

        def count(update: int, first=first, kept=kept, solved=solved) -> None:
            report((first * updates + kept * update) * config.steps_per_update, solved)

        mine, ids = take(levels, index), jnp.asarray(level_ids[index], jnp.int32)
        slots, curve = train(mine, ids, updates, config, rules, count)
        judged, witness = judge(mine, ids, slots, curve, config, rules, failed[index])
        for place, verdict in zip(index[:kept], judged, strict=False):
            verdicts[place] = verdict
        actions[..., index[:kept]] = witness[..., :kept]
        solved += sum(verdict.label is Label.SOLVED for verdict in judged[:kept])
    known = [verdict for verdict in verdicts if verdict is not None]
    record = replay(levels, actions, rules)
    witnessed = np.array([verdict.label in WITNESSED for verdict in known])
    record = jax.tree.map(lambda x: np.where(witnessed, x, np.zeros_like(x)), record)
    return UnitResult(level_ids.astype(np.int64), levels, record, known)


def updates_in(budget: int, config: ExpertConfig) -> int:
    """How many updates a budget pays for.

    Raises:
        ValueError: not even one.
    """
    if budget < config.steps_per_update:
        raise ValueError(
            f"a budget of {budget} env steps is too small: one update of an expert takes {config.steps_per_update} "
            f"(environments {config.environments} x horizon {config.horizon})"
        )
    return budget // config.steps_per_update


def slot_count(config: ExpertConfig) -> int:
    """How many experts train side by side in one program."""
    if config.slots:
        return config.slots
    lanes = LANES_IN_CACHE if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR
    return max(1, lanes // config.environments)


def _batches(count: int, slots: int) -> Iterator[tuple[int, np.ndarray]]:
    """First level and level numbers of each batch; the last is filled up with its last level."""
    for first in range(0, count, slots):
        yield first, np.minimum(np.arange(first, first + slots), count - 1)


def train(
    levels: Level,
    level_ids: Int[Array, " slot"],
    updates: int,
    config: ExpertConfig,
    rules: TaskParams,
    count: Callable[[int], None] = lambda update: None,
) -> tuple[Slots, Float[np.ndarray, "update slot"]]:
    """Train a batch of experts for so many updates; their learning curves."""
    slots = _start(levels, level_ids, config)
    shaped = replace(rules, dense_reward_scale=config.dense_reward_scale)
    greedy = jnp.zeros(config.environments, bool)
    curve = []
    for update in range(updates):
        keys = _keys(level_ids, Stream.EXPERT, update + 1)
        world, experience, last_value = _act(slots.experts.params, levels, slots.world, keys, greedy, config, shaped)
        slots, share = _learn(slots._replace(world=world), levels, keys, experience, last_value, config)
        curve.append(share)
        if update:  # one update behind, so that the device never waits for the host
            curve[-2].block_until_ready()
            count(update)
    count(updates)
    return slots, np.stack(jax.device_get(curve))


def network_of(levels: Level, config: ExpertConfig) -> ActorCritic:
    return ActorCritic(levels.size, config.width, config.depth)


@partial(jax.jit, static_argnames=("stream",))
def _keys(level_ids: Int[Array, " slot"], stream: Stream, index) -> Key[Array, " slot"]:
    return jax.vmap(lambda level_id: jax.random.fold_in(key_for(level_id, stream), index))(level_ids)


@partial(jax.jit, static_argnames="config")
def _start(levels: Level, level_ids: Int[Array, " slot"], config: ExpertConfig) -> Slots:
    size, network = levels.size, network_of(levels, config)
    dynamic = len(dynamic_features(size))
    fresh = lambda key: ppo.init(key, network, feature_count(size), dynamic, config)
    experts = jax.vmap(fresh)(_keys(level_ids, Stream.EXPERT, 0))
    world = task.reset(repeat(levels, config.environments))
    return Slots(experts, world, progress.start(len(level_ids), config.environments))


@partial(jax.jit, static_argnames=("config", "rules"))
def _act(params, levels: Level, world: TaskState, keys, greedy, config: ExpertConfig, rules: TaskParams):
    """One rollout of every slot. Training and evaluation share this program."""
    network = network_of(levels, config)
    return rollout(network, params, levels, world, keys, greedy, config.horizon, rules)


@partial(jax.jit, static_argnames="config", donate_argnames="slots")
def _learn(
    slots: Slots,
    levels: Level,
    keys: Key[Array, " slot"],
    experience: Experience,
    last_value: Float[Array, "slot environment"],
    config: ExpertConfig,
) -> tuple[Slots, Float[Array, " slot"]]:
    """One update of every slot."""
    network, constant = network_of(levels, config), level_features(levels)
    seen, share = progress.follow(slots.progress, experience.reward, experience.done, experience.goal)
    advantage = ppo.advantages(experience.value, experience.reward, experience.done, last_value, config)
    chance = experience.log_probability
    batch = Batch(experience.moving, experience.action, chance, experience.value, advantage)
    samples = jax.vmap(ppo.as_samples, in_axes=-2)(batch)

    def learn(slot):
        expert, key, constant, samples = slot
        shuffling = jax.random.fold_in(key, config.horizon)  # the rollout used 0 .. horizon - 1
        return ppo.update(expert, shuffling, network, constant, samples, config)

    # one expert after another: an expert's minibatch stays in a core's cache
    experts = jax.lax.map(learn, (slots.experts, keys, constant.T, samples))
    return Slots(experts, slots.world, seen), share


def judge(
    levels: Level,
    level_ids: Int[Array, " slot"],
    slots: Slots,
    curve: Float[np.ndarray, "update slot"],
    config: ExpertConfig,
    rules: TaskParams,
    failed_by_noop: Bool[np.ndarray, " slot"],
) -> tuple[list[Verdict], Int[np.ndarray, "256 6 slot"]]:
    """Evaluate trained experts; verdicts, and the witnesses' actions (0 where there is none)."""
    action, done, goal = evaluate(levels, level_ids, slots.experts.params, config, rules)
    chosen, record = choose(levels, action, done, goal, rules)
    witness = action[..., np.arange(len(chosen)), np.maximum(chosen, 0)]
    totals = jax.device_get(slots.progress)
    verdicts = []
    for i, attempt in enumerate(chosen):
        solved, first = attempt >= 0, int(totals.first_success[i])
        ended = int(done[:, i].sum())
        episodes = int(record.done[:, i].sum())
        verdicts.append(
            Verdict(
                label=Label.SOLVED if solved else Label.UNSOLVED,
                label_reason=solved_reason(attempt > 0, episodes)
                if solved
                else unsolved_reason(config.attempts, first != NEVER),
                failed_by_noop=bool(failed_by_noop[i]),
                success_rate=float(goal[:, i].sum() / ended) if ended else float("nan"),
                steps_to_goal=int(steps_to_goal(record.done)[i]) if solved else None,
                steps_to_first_success=None if first == NEVER else first,
                env_steps=int(totals.env_steps),
                learning_curve=curve[:, i].tolist(),
                best_return=float(totals.best_return[i]),
                episodes=int(totals.episodes[i]),
            )
        )
    return verdicts, np.where(chosen >= 0, witness, 0)


def evaluate(
    levels: Level, level_ids: Int[Array, " slot"], params, config: ExpertConfig, rules: TaskParams
) -> tuple[
    Int[np.ndarray, "256 6 slot attempt"], Bool[np.ndarray, "256 slot attempt"], Bool[np.ndarray, "256 slot attempt"]
]:
    """Actions, ends and goals of every attempt at a record. Attempt 0 takes the most probable actions."""
    shaped = replace(rules, dense_reward_scale=config.dense_reward_scale)  # the training's program
    world = task.reset(repeat(levels, config.environments))
    greedy = jnp.arange(config.environments) == 0
    parts = []
    for part in range(-(-RECORD_STEPS // config.horizon)):
        keys = _keys(level_ids, Stream.EVALUATION, part)
        world, seen, _ = _act(params, levels, world, keys, greedy, config, shaped)
        parts.append(jax.device_get((seen.action, seen.done, seen.goal)))
    action, done, goal = (np.concatenate(x)[:RECORD_STEPS, ..., : config.attempts] for x in zip(*parts, strict=True))
    return action, done, goal


def choose(levels: Level, action, done, goal, rules: TaskParams) -> tuple[Int[np.ndarray, " slot"], Record]:
    """The first attempt of each level that succeeds, and does so again when its actions are replayed; -1: none."""
    attempts = done.shape[-1]
    promising = succeeds(done, goal)
    while True:
        chosen = np.where(promising.any(-1), promising.argmax(-1), -1)
        index = np.arange(len(chosen)), np.maximum(chosen, 0)
        record = replay(levels, action[..., *index], rules)
        failed = (chosen >= 0) & ~succeeds(record.done, record.goal)
        if not failed.any():
            return chosen, record
        promising &= ~(failed[:, None] & (np.arange(attempts) == chosen[:, None]))
