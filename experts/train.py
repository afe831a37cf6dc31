"""Training: levels go through the slots, then witnesses are chosen and verdicts given.

Levels that need no expert (`experts.before`) get none, and use nothing of their budget.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from experts.before import decide
from experts.config import RECORD_STEPS, ExpertConfig, StopConfig
from experts.judge import Evaluation, Kept, Trained, judge, witness_of
from experts.labels import WITNESSED, Label, Verdict
from experts.slots import Begun, Mode, Queue, Slots, advance, begin, empty_slots
from experts.witness import Record, replay, take
from levelgen.level import ACTIONS, Level
from levelgen.task import DEFAULT_RULES, TaskParams

LANES_IN_CACHE = 128  # their physics and one minibatch fit the cache of a core
LANES_ON_ACCELERATOR = 32_768
BLOCK = 16  # experts that one call of `begin` makes
DEFAULT_STOP = StopConfig()
NOTHING_BEGUN: Mapping[int, Kept] = MappingProxyType({})

Tell = Callable[[int, float, int], None]  # totals so far: env steps, levels (parts count), solved levels


class Spent(NamedTuple):
    """Env steps of all lanes."""

    trained: int
    evaluated: int
    idle: int  # in slots that had no level


@dataclass(frozen=True)
class UnitResult:
    """What came of some levels, on the host, in the order they were given."""

    level_ids: np.ndarray  # int64
    levels: Level
    record: Record  # all zero where the level has no witness
    verdicts: list[Verdict]
    spent: Spent
    experts: dict[int, Kept] = field(default_factory=dict)  # by level id, where they are kept


def train_levels(
    levels: Level,
    level_ids: np.ndarray,
    budget: int,
    config: ExpertConfig,
    stopping: StopConfig = DEFAULT_STOP,
    rules: TaskParams = DEFAULT_RULES,
    report: Tell = lambda env_steps, levels, solved: None,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
    keep: bool = False,
) -> UnitResult:
    """Label the levels; train an expert for each that needs one.

    Args:
        levels: the levels, as their ids rebuild them.
        level_ids: their ids; the seeds of all randomness.
        budget: env steps that each expert may use.
        config: what an expert is.
        stopping: when a level leaves its slot.
        rules: of the task; records hold its rewards, training shapes with the configuration's.
        report: called now and then with totals over all experts.
        begun: by level id, experts that go on with what they have left of the budget; the others begin.
        keep: whether the result has the experts.

    Raises:
        ValueError: the budget does not suffice for one update.
    """
    updates = updates_in(budget, config)
    level_ids = np.asarray(level_ids)
    levels = jax.tree.map(np.asarray, levels)
    before, failed = decide(levels, rules)
    left = np.array([i for i, verdict in enumerate(before) if verdict is None], int)
    known_before = len(before) - len(left)
    tell = lambda env_steps, through, solved: report(env_steps, known_before + through, solved)
    mine = {place: begun[level_id] for place, level_id in enumerate(level_ids[left].tolist()) if level_id in begun}
    trained, spent = train(take(levels, left), level_ids[left], updates, config, stopping, rules, tell, mine, keep)
    judged, witness = judge(take(levels, left), trained, updates, config, rules, failed[left])
    verdicts = {int(i): verdict for i, verdict in zip(left, judged, strict=True)}
    known = [verdict or verdicts[i] for i, verdict in enumerate(before)]
    actions = np.zeros((RECORD_STEPS, ACTIONS, len(level_ids)), np.int32)  # doing nothing, where none are found
    actions[..., left] = witness
    record = replay(levels, actions, rules)
    witnessed = np.array([verdict.label in WITNESSED for verdict in known])
    record = jax.tree.map(lambda x: np.where(witnessed, x, np.zeros_like(x)), record)
    report(spent.trained, len(known), sum(verdict.label is Label.SOLVED for verdict in known))
    ended = zip(level_ids[left].tolist(), trained, strict=True)
    experts = {level_id: of.expert for level_id, of in ended if of.expert is not None}
    return UnitResult(level_ids.astype(np.int64), levels, record, known, spent, experts)


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


def train(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    updates: int,
    config: ExpertConfig,
    stopping: StopConfig,
    rules: TaskParams,
    report: Tell = lambda env_steps, levels, solved: None,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
    keep: bool = False,
) -> tuple[list[Trained], Spent]:
    """Each level through a slot, until it is decided or has had so many updates. `begun` is by place."""
    count = len(level_ids)
    if not count:
        return [], Spent(0, 0, 0)
    shaped = replace(rules, dense_reward_scale=config.dense_reward_scale)
    queue = queue_of(levels, level_ids, updates, config, begun)
    slots = empty_slots(slot_count(config), queue, config)
    curves = [list(begun[place].curve) if place in begun else [] for place in range(count)]
    evaluations: list[list[Evaluation]] = [[] for _ in range(count)]
    experts: list[Kept | None] = [None] * count
    rollouts, left, solved = Counter(), 0, 0
    while left < count:
        slots, now = advance(slots, queue, config, stopping, shaped)
        seen = jax.device_get(now)
        rollouts.update(seen.mode.tolist())
        for slot in np.flatnonzero(seen.mode == Mode.TRAIN):
            curves[seen.place[slot]].append(float(seen.share[slot]))
        for slot in np.flatnonzero(seen.evaluated).tolist():
            evaluations[seen.place[slot]].append(evaluation_of(slots, slot, config))
        for slot in np.flatnonzero(seen.left).tolist():
            place = seen.place[slot]
            left, solved = left + 1, solved + (witness_of(evaluations[place], config) is not None)
            if keep:
                experts[place] = Kept(expert_of(slots, slot, config), curves[place])
        under_way = sum(len(curves[place]) for place in seen.place[~seen.left & (seen.mode != Mode.EMPTY)])
        report(rollouts[Mode.TRAIN] * config.steps_per_update, left + under_way / updates, solved)
    spent = (rollouts[mode] * config.steps_per_update for mode in (Mode.TRAIN, Mode.EVALUATE, Mode.EMPTY))
    return [Trained(*of) for of in zip(curves, evaluations, experts, strict=True)], Spent(*spent)


def queue_of(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    updates: int,
    config: ExpertConfig,
    begun: Mapping[int, Kept] = NOTHING_BEGUN,
) -> Queue:
    """The levels as a queue on the device. Its capacity is a power of two: few shapes are compiled."""
    count = len(level_ids)
    places = np.minimum(np.arange(max(BLOCK, 1 << (count - 1).bit_length())), count - 1)
    levels, ids = take(levels, places), np.asarray(level_ids, np.int32)[places]
    blocks = [np.arange(first, first + BLOCK) for first in range(0, len(places), BLOCK)]
    fresh = [begin(take(levels, block), ids[block], config) for block in blocks]
    experts = jax.tree.map(lambda *parts: jnp.concatenate(parts), *fresh) if len(fresh) > 1 else fresh[0]
    if begun:
        experts = jax.tree.map(np.array, experts)
        for place, expert in begun.items():
            jax.tree.map(partial(_put, place), experts, expert.begun)
    return jax.device_put(Queue(levels, jnp.asarray(ids), np.int32(count), np.int32(updates), experts))


def _put(place: int, rows: np.ndarray, row: np.ndarray) -> None:
    rows[place] = row


def expert_of(slots: Slots, slot: int, config: ExpertConfig) -> Begun:
    """The expert that has just left a slot, on the host, as it would go on."""
    lanes = np.arange(slot * config.environments, (slot + 1) * config.environments)
    training, acting = jax.tree.map(lambda x: x[slot], slots.slot.training), take(slots.acting, lanes)
    return jax.device_get(Begun(training, acting))


def evaluation_of(slots: Slots, slot: int, config: ExpertConfig) -> Evaluation:
    """What the evaluation that has just ended in a slot showed."""
    mine = jax.tree.map(
        lambda x: x[slot], (slots.slot.trial, slots.slot.training.progress, slots.slot.training.success)
    )
    trial, progress, success = jax.device_get(mine)
    record = slice(0, RECORD_STEPS)
    done, goal = trial.done[record], trial.goal[record]
    return Evaluation(trial.action[record].astype(np.int32), done, goal, progress, success)
