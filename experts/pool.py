"""Levels in training: they wait in the queue, go through the slots, and leave.

Several threads may share a pool, each with levels of its own: those of one take the slots that those of another leave
empty. A result depends on nothing but its level, so sharing changes none.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from threading import Condition
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from experts.config import RECORD_STEPS, ExpertConfig, StopConfig
from experts.judge import Evaluation, Kept, Trained, Witness, witness_of
from experts.queue import BLOCK, empty_queue, enter, next_places
from experts.slots import Begun, Mode, Queue, Report, Slots, advance, empty_slots
from experts.witness import take
from levelgen.level import Level
from levelgen.task.rules import TaskParams

LANES_IN_CACHE = 128  # their physics and one minibatch fit the cache of a core
LANES_ON_ACCELERATOR = 32_768
PLACES_PER_SLOT = 4  # in the queue: a level that stays long keeps none from coming that could have a slot
NOTHING_BEGUN: Mapping[int, Kept] = MappingProxyType({})

Tell = Callable[[int, float, int], None]  # totals so far: env steps, levels (parts count), solved levels


def quiet(env_steps: int, levels: float, solved: int) -> None:
    """Tells nobody."""


class Spent(NamedTuple):
    """Env steps of all lanes."""

    trained: int
    evaluated: int
    idle: int  # in slots that had no level


class Batch:
    """Levels that came together, and what has become of each so far. `begun` is by place among them."""

    def __init__(
        self, levels: Level, level_ids: Int[np.ndarray, " level"], begun: Mapping[int, Kept], keep: bool, tell: Tell
    ) -> None:
        count = len(level_ids)
        self.levels, self.level_ids, self.begun, self.keep, self.tell = levels, level_ids, begun, keep, tell
        self.curves = [list(begun[i].curve) if i in begun else [] for i in range(count)]
        self.evaluations: list[list[Evaluation]] = [[] for _ in range(count)]
        self.experts: list[Kept | None] = [None] * count
        self.witnesses: list[Witness | None] = [None] * count
        self.under_way = set(range(count))
        self.solved = 0
        self.rollouts: Counter[int] = Counter()  # by mode

    def trained(self) -> list[Trained]:
        return [Trained(*of) for of in zip(self.curves, self.evaluations, self.experts, self.witnesses, strict=True)]

    def spent(self, config: ExpertConfig) -> Spent:
        modes = Mode.TRAIN, Mode.EVALUATE, Mode.EMPTY
        return Spent(*(self.rollouts[mode] * config.steps_per_update for mode in modes))


class Pool:
    """Slots and the queue before them. All that trains in it has one configuration and one budget."""

    def __init__(self, updates: int, config: ExpertConfig, stopping: StopConfig, rules: TaskParams) -> None:
        self.updates, self.config, self.stopping, self.rules = updates, config, stopping, rules
        self.error: BaseException | None = None  # after which nothing more can be trained here
        self._shaped = replace(rules, dense_reward_scale=config.dense_reward_scale)
        self._slots: Slots | None = None  # these two are there once the first levels have come
        self._queue: Queue | None = None
        self._taken = 0  # levels that left the queue, ever
        self._at: dict[int, tuple[Batch, int]] = {}  # by place in the queue: levels that have not left their slots
        self._coming: deque[tuple[Batch, range]] = deque()  # levels that wait for places in the queue
        self._batches: list[Batch] = []  # not done
        self._changed, self._led = Condition(), False  # a thread is at work, for all

    def train(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        tell: Tell = quiet,
        begun: Mapping[int, Kept] = NOTHING_BEGUN,
        keep: bool = False,
    ) -> tuple[list[Trained], Spent]:
        """Each level through a slot, until it is decided or has had its budget.

        Of the threads that wait here, one advances the slots, for all.

        Args:
            levels: on the host.
            level_ids: their ids.
            tell: called now and then with totals over these levels.
            begun: by place among them, experts that go on.
            keep: whether the result has the experts.

        Raises:
            RuntimeError: another thread failed while it advanced the slots.
        """
        batch = Batch(levels, np.asarray(level_ids, np.int32), begun, keep, tell)
        with self._changed:
            if batch.under_way:
                self._batches.append(batch)
            count = len(level_ids)
            self._coming.extend((batch, range(i, min(i + BLOCK, count))) for i in range(0, count, BLOCK))
        while batch.under_way:
            with self._changed:
                self._changed.wait_for(lambda: not (self._led and batch.under_way))
                if not batch.under_way:
                    break
                if self.error is not None:
                    raise RuntimeError(f"levels that trained beside these failed: {self.error!r}") from self.error
                self._led = True
            try:
                while batch.under_way:
                    self._advance()
            except BaseException as error:
                self.error = error
                raise
            finally:
                with self._changed:
                    self._led = False
                    self._changed.notify_all()
        return batch.trained(), batch.spent(self.config)

    @property
    def wants(self) -> int:
        """Levels by which as many would wait as there are slots: with them none is empty for a while."""
        with self._changed:
            come = int(self._queue.count) if self._queue else 0
            waiting = come - self._taken + sum(len(some) for _, some in self._coming)
            return max(0, slot_count(self.config) - waiting)

    def _advance(self) -> None:
        """A rollout in every slot, and the account of it."""
        self._fill()
        assert self._queue is not None
        assert self._slots is not None
        self._slots, report = advance(self._slots, self._queue, self.config, self.stopping, self._shaped)
        seen = jax.device_get(report)
        self._taken = int(seen.taken)
        self._batches[-1].rollouts[Mode.EMPTY] += int((seen.mode == Mode.EMPTY).sum())
        for slot in np.flatnonzero(seen.mode != Mode.EMPTY).tolist():
            self._note(slot, seen)
        for batch in self._batches:
            parts = sum(len(batch.curves[i]) for i in batch.under_way) / self.updates
            steps = batch.rollouts[Mode.TRAIN] * self.config.steps_per_update
            batch.tell(steps, len(batch.curves) - len(batch.under_way) + parts, batch.solved)
        with self._changed:
            self._batches = [batch for batch in self._batches if batch.under_way]
            self._changed.notify_all()

    def _fill(self) -> None:
        """Let levels into the queue while there are places for the next block of them."""
        while self._coming:
            batch, some = self._coming[0]
            if self._queue is None:
                self._queue = empty_queue(batch.levels, capacity_of(self.config), self.updates, self.config)
                self._slots = empty_slots(slot_count(self.config), self._queue, self.config)
            places = next_places(self._queue, len(some))
            if not self._at.keys().isdisjoint(places):
                return
            begun = {i - some.start: batch.begun[i].begun for i in some if i in batch.begun}
            at = np.array(some)
            queue = enter(self._queue, take(batch.levels, at), batch.level_ids[at], self.config, begun)
            self._at.update({place: (batch, i) for place, i in zip(places, some, strict=True)})
            with self._changed:
                self._queue = queue
                self._coming.popleft()

    def _note(self, slot: int, seen: Report) -> None:
        """What became of the level in a slot."""
        assert self._slots is not None
        place = int(seen.place[slot])
        batch, i = self._at[place]
        batch.rollouts[int(seen.mode[slot])] += 1
        if seen.mode[slot] == Mode.TRAIN:
            batch.curves[i].append(float(seen.share[slot]))
        if seen.evaluated[slot]:
            batch.evaluations[i].append(evaluation_of(self._slots, slot, self.config))
        if seen.left[slot]:
            if batch.keep:
                batch.experts[i] = Kept(expert_of(self._slots, slot, self.config), batch.curves[i])
            batch.witnesses[i] = witness_of(batch.evaluations[i], self.config)
            batch.solved += batch.witnesses[i] is not None
            del self._at[place]
            batch.under_way.remove(i)


def slot_count(config: ExpertConfig) -> int:
    """How many experts train side by side in one program."""
    if config.slots:
        return config.slots
    lanes = LANES_IN_CACHE if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR
    return max(1, lanes // config.environments)


def capacity_of(config: ExpertConfig) -> int:
    """How many levels a queue has places for: one number for a configuration, so that one program is compiled."""
    return max(PLACES_PER_SLOT * slot_count(config), 2 * BLOCK)


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
