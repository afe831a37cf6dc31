"""A worker's pool: levels are searched, wait in the queue, train in slots, and leave.

Levels are submitted together and finish together; submissions share the slots. A level's result depends on that level
alone, so sharing changes no result.
"""

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS, ExpertConfig, check_budget
from levelproof.experts.ledger import Lap, Ledger, StepCosts, lap
from levelproof.experts.policy import Params
from levelproof.experts.pool.found import SearchFindings, nothing_found, row_of
from levelproof.experts.pool.paused import Paused
from levelproof.experts.pool.queue import GROUP, empty_queue, enter
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.search import Searching
from levelproof.experts.training.advance import advance, train_on
from levelproof.experts.training.slots import ExpertState, LevelQueue, Mode, Pending, Report, Slots, empty_slots
from levelproof.experts.training.stop import rules_of
from levelproof.experts.verdict.judge import (
    Evaluation,
    KeptExpert,
    TrainedLevel,
    Witness,
    candidates_of,
    shortest_first,
    witnesses_in,
)
from levelproof.experts.verdict.portability import PORTABLE, choose
from levelproof.levelgen.batching import at_once, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

IN_CACHE = 128  # lanes: their physics and one minibatch fit the cache of a core
QUEUED_PER_SLOT = (
    4  # levels in the queue per slot, those in slots included: enough wait while the next group does not fit
)
T = TypeVar("T")
NOTHING_BEGUN: Mapping[int, KeptExpert] = MappingProxyType({})
NONE_PAUSED: Mapping[int, Paused] = MappingProxyType({})


class Totals(NamedTuple):
    """Progress of some levels."""

    env_steps: int  # of training
    levels: float  # decided; those in training count by the share of their budget used
    solved: int


class Submission:
    """Levels submitted together, and the results of each so far. Arguments as in `Pool.submit`."""

    def __init__(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        found: SearchFindings,
        begun: Mapping[int, KeptExpert],
        keep: bool,
        paused: Mapping[int, Paused],
    ) -> None:
        count = len(level_ids)
        self.levels, self.level_ids, self.found, self.keep, self.paused = levels, level_ids, found, keep, paused
        self.begun = {**begun, **{i: expert.expert for i, expert in paused.items()}}
        self.curves = [list(self.begun[i].curve) if i in self.begun else [] for i in range(count)]
        self.evaluations = [list(paused[i].evaluations) if i in paused else [] for i in range(count)]
        self.experts: list[KeptExpert | None] = [None] * count
        self.candidates: list[list[Witness]] = [[] for _ in range(count)]
        self.policies: list[Params | None] = [None] * count
        self.under_way = set(range(count))
        self.solved = 0
        self.trained_rollouts = self.idle_rollouts = 0
        self.ledger = Ledger(count)
        self.evaluated_rollouts = np.array(
            [paused[i].evaluated_rollouts if i in paused else 0 for i in range(count)], int
        )

    def trained(self, config: ExpertConfig) -> list[TrainedLevel]:
        evaluated = (self.evaluated_rollouts * config.steps_per_update).tolist()
        columns = self.curves, self.evaluations, self.experts, self.candidates, evaluated, self.policies
        return [TrainedLevel(*level) for level in zip(*columns, strict=True)]


class Pool:
    """The search, the queue and the slots of a worker, for one procedure and one budget."""

    def __init__(self, budget: int, procedure: Procedure, rules: TaskParams) -> None:
        """`budget` is in env steps per expert. Raises ValueError as `check_budget` does."""
        check_budget(budget, procedure.expert, procedure.stop)
        self.procedure, self.config, self.rules = procedure, procedure.expert, rules
        self.updates = self.config.updates_in(budget)
        self.searching = Searching(procedure.search, rules)
        self._stopping = rules_of(procedure.stop, self.config)
        self._shaped = replace(rules, dense_reward_scale=self.config.dense_reward_scale)
        self._slots: Slots | None = None  # both None until the first levels arrive
        self._queue: LevelQueue | None = None
        self._taken = 0  # total number of levels that have left the queue
        # By index in the queue, in order of arrival: levels in the queue or in slots
        self._at: dict[int, tuple[Submission, int]] = {}
        self._coming: deque[tuple[Submission, Sequence[int]]] = deque()  # levels that wait to enter the queue
        self._submissions: list[Submission] = []  # unfinished
        self._steps = StepCosts()

    def submit(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        found: SearchFindings | None = None,
        begun: Mapping[int, KeptExpert] = NOTHING_BEGUN,
        keep: bool = False,
        paused: Mapping[int, Paused] = NONE_PAUSED,
    ) -> Submission:
        """Queue levels for slots: each trains in one until it is decided or has used its budget.

        Args:
            levels: the levels, on the host.
            level_ids: their ids.
            found: search results, whose successes their experts rehearse from the start; None: none.
            begun: earlier experts to continue, by index among the levels.
            keep: whether to return the experts.
            paused: interrupted experts to resume, by index among the levels.
        """
        count = len(level_ids)
        submission = Submission(levels, level_ids, found or nothing_found(count), begun, keep, paused)
        self._submissions.append(submission)
        self._coming.extend((submission, range(i, min(i + GROUP, count))) for i in range(0, count, GROUP))
        return submission

    def step(self) -> list[Submission]:
        """Search if too few levels wait for slots, else advance all slots by a rollout; return finished submissions.

        After an exception the pool is unusable, because its slots were donated.
        """
        searched = self._short and self.searching.step()
        if not searched and any(submission.under_way for submission in self._submissions):
            self._advance()
        finished = [submission for submission in self._submissions if not submission.under_way]
        self._submissions = [submission for submission in self._submissions if submission.under_way]
        return finished

    def wants(self, searched: int) -> int:
        """Return the number of levels to submit to keep slots and search slots busy.

        `searched` levels are in the search or wait for it; all of them may come to the slots.
        """
        return max(self._short - searched, self.searching.wants, 0)

    @property
    def _short(self) -> int:
        """Number of levels missing until as many wait as there are slots."""
        come = int(self._queue.come) if self._queue else 0
        waiting = come - self._taken + sum(len(some) for _, some in self._coming)
        return max(0, slot_count(self.config) - waiting)

    def waiting(self, submission: Submission) -> list[int]:
        """Return indices of the submission's levels that have had no slot, ascending."""
        coming = (i for other, some in self._coming for i in some if other is submission)
        return [*(i for _, (other, i) in self._queued() if other is submission), *coming]

    def withdraw(self, submission: Submission, indices: Collection[int]) -> None:
        """Remove levels that have had no slot."""
        queued = self._queued()
        for index, _ in queued:
            del self._at[index]
        if self._queue is not None:
            self._queue = self._queue._replace(come=np.int32(self._taken))
        levels = [level for _, level in queued] + [(other, i) for other, some in self._coming for i in some]
        left = [(other, i) for other, i in levels if other is not submission or i not in indices]
        self._coming = deque()
        for _, same in groupby(left, lambda level: id(level[0])):
            other, some = zip(*same, strict=True)
            self._coming.extend((other[0], some[i : i + GROUP]) for i in range(0, len(some), GROUP))
        submission.under_way.difference_update(indices)

    def totals(self, submission: Submission) -> Totals:
        """Return the progress of a submission."""
        parts = sum(len(submission.curves[i]) for i in submission.under_way) / self.updates
        steps = submission.trained_rollouts * self.config.steps_per_update
        decided = len(submission.curves) - len(submission.under_way)
        return Totals(steps, decided + parts, submission.solved)

    def paused(self) -> Iterator[tuple[Submission, int, Paused]]:
        """Yield every expert in a slot, ready to resume, with its submission and index there."""
        if self._slots is None:
            return
        slot = self._slots.slot
        now = jax.device_get(
            (slot.mode, slot.queue_index, slot.trial.part, slot.deadline, slot.trial.due, slot.trial.final)
        )
        for number, (mode, index, part, deadline, due, final) in enumerate(zip(*now, strict=True)):
            if mode == Mode.EMPTY:
                continue
            submission, i = self._at[int(index)]
            evaluating = mode == Mode.EVALUATE
            yield (
                submission,
                i,
                Paused(
                    KeptExpert(expert_of(self._slots, number, self.config), list(submission.curves[i])),
                    Pending(evaluating & due, evaluating & final, deadline),
                    int(submission.evaluated_rollouts[i]) - (int(part) if evaluating else 0),
                    list(submission.evaluations[i]),
                    row_of(submission.found, i),
                ),
            )

    def _queued(self) -> list[tuple[int, tuple[Submission, int]]]:
        """Return levels in the queue that have had no slot, in order, with their indices in the queue."""
        count = int(self._queue.come) - self._taken if self._queue else 0
        return list(self._at.items())[len(self._at) - count :]

    def _advance(self) -> None:
        """Advance every slot by a rollout, and charge its time to the levels."""
        with lap() as took:
            self._fill()
            assert self._queue is not None
            assert self._slots is not None
            self._slots, report = advance(self._slots, self._queue, self.config, self._stopping, self._shaped)
            seen = jax.device_get(report)
            self._taken = int(seen.taken)
            # charge empty slots to the last submission, so that they count once
            self._submissions[-1].idle_rollouts += int((seen.mode == Mode.EMPTY).sum())
            busy = np.flatnonzero(seen.mode != Mode.EMPTY).tolist()
            levels = [self._at[int(seen.queue_index[slot])] for slot in busy]
            for slot, (submission, i) in zip(busy, levels, strict=True):
                self._note(slot, seen, submission, i)
        self._leave(seen, {slot: level for slot, level in zip(busy, levels, strict=True) if seen.left[slot]})
        trains = (seen.mode[busy] == Mode.TRAIN).tolist()
        training, evaluation = self._steps.split(took.seconds, sum(trains), len(seen.mode))
        for train, (submission, i) in zip(trains, levels, strict=True):
            submission.ledger.put(*(("training", i, training) if train else ("evaluation", i, evaluation)))
        idle = evaluation * (len(seen.mode) - len(busy))
        self._submissions[-1].ledger.add("idle", Lap(idle, took.compiling))

    def _fill(self) -> None:
        """Move levels into the queue while the next group fits."""
        while self._coming:
            submission, some = self._coming[0]
            if self._queue is None:
                self._queue = empty_queue(submission.levels, capacity_of(self.config), self.config)
                self._slots = empty_slots(slot_count(self.config), self._queue, self.config)
            free = [index for index in range(self._queue.capacity) if index not in self._at]
            if len(free) < len(some):
                return
            indices = free[: len(some)]
            begun = {row: self._continued(submission, i) for row, i in enumerate(some) if i in submission.begun}
            at = np.array(some)
            success = jax.tree.map(lambda x, at=at: x[at], submission.found.success)
            levels, level_ids = take(submission.levels, at), submission.level_ids[at]
            self._queue = enter(self._queue, indices, levels, level_ids, success, self.config, self.updates, begun)
            self._at.update({index: (submission, i) for index, i in zip(indices, some, strict=True)})
            self._coming.popleft()

    def _continued(self, submission: Submission, i: int) -> tuple[ExpertState, Pending]:
        """Return an expert that continues, and what comes next for it."""
        no = np.bool_(False)
        fresh = Pending(no, no, np.int32(self.updates))
        return submission.begun[i].begun, submission.paused[i].pending if i in submission.paused else fresh

    def _note(self, slot: int, seen: Report, submission: Submission, i: int) -> None:
        """Record what happened to a level in its slot."""
        assert self._slots is not None
        if seen.mode[slot] == Mode.TRAIN:
            submission.trained_rollouts += 1
            submission.curves[i].append(float(seen.share[slot]))
        else:
            submission.evaluated_rollouts[i] += 1
        if seen.evaluated[slot]:
            submission.evaluations[i].append(evaluation_of(self._slots, slot))

    def _leave(self, seen: Report, levels: Mapping[int, tuple[Submission, int]]) -> None:
        """Release finished levels from their slots; early leavers with a fragile witness train on."""
        assert self._slots is not None
        for submission, i in levels.values():
            submission.candidates[i] = self._candidates(submission, i)
        stay = self._fragile({slot: level for slot, level in levels.items() if seen.early[slot]})
        for slot, (submission, i) in levels.items():
            if slot in stay:
                continue
            if submission.keep:
                submission.experts[i] = KeptExpert(expert_of(self._slots, slot, self.config), submission.curves[i])
            submission.policies[i] = jax.device_get(_row(self._slots.slot.training.train_state.params, slot))
            submission.solved += bool(submission.candidates[i])
            del self._at[int(seen.queue_index[slot])]
            submission.under_way.remove(i)
        if stay:
            self._slots = train_on(self._slots, np.isin(np.arange(len(seen.left)), stay), self._stopping)

    def _candidates(self, submission: Submission, i: int) -> list[Witness]:
        """For a level's witness: the best so far, if it has been chosen, and what the last evaluation adds."""
        evaluations, best = submission.evaluations[i], submission.candidates[i]
        if best:
            return shortest_first([*best, *witnesses_in(evaluations[-1], self.config)])
        return candidates_of(evaluations, submission.found.source[i], self.config)

    def _fragile(self, solved: Mapping[int, tuple[Submission, int]]) -> list[int]:
        """Return slots of solved levels without a portable witness; each level keeps its best candidate."""
        if not (solved and self.procedure.stop.steady and self.config.replays):
            return []
        with lap() as took:
            each = [take(submission.levels, np.array([i])) for submission, i in solved.values()]
            levels = jax.tree.map(lambda *xs: np.concatenate(xs, -1), *each)
            level_ids = np.array([submission.level_ids[i] for submission, i in solved.values()])
            candidates = [submission.candidates[i] for submission, i in solved.values()]
            best = choose(levels, level_ids, candidates, self.config.replays, self.rules)
        slots = []
        for (slot, (submission, i)), witness in zip(solved.items(), best, strict=True):
            assert witness is not None
            submission.candidates[i] = [witness]
            submission.ledger.put("replay", i, took.seconds / len(solved))
            submission.ledger.put("compiling", i, took.compiling / len(solved))
            if (witness.portability or 0) < PORTABLE:
                slots.append(slot)
        return slots


def slot_count(config: ExpertConfig) -> int:
    """Return the number of experts that train side by side in one program."""
    return config.slots or at_once(config.environments, IN_CACHE)


def capacity_of(config: ExpertConfig) -> int:
    """Return the queue's capacity: one number per configuration, so that one program is compiled."""
    return max(QUEUED_PER_SLOT * slot_count(config), 2 * GROUP)


def expert_of(slots: Slots, slot: int, config: ExpertConfig) -> ExpertState:
    """Copy the expert in a slot, or that has just left it, to the host, ready to continue."""
    lanes = np.arange(slot * config.environments, (slot + 1) * config.environments)
    return jax.device_get(ExpertState(_row(slots.slot.training, slot), take(slots.acting, lanes)))


def evaluation_of(slots: Slots, slot: int) -> Evaluation:
    """Copy the evaluation that has just ended in a slot to the host."""
    training = slots.slot.training
    shown = slots.slot.trial, training.progress, training.success, training.course.over
    trial, progress, success, over = jax.device_get(_row(shown, slot))
    record = slice(0, RECORD_STEPS)
    done, goal = trial.done[record], trial.goal[record]
    return Evaluation(trial.action[record].astype(np.int32), done, goal, progress, success, over)


@jax.jit
def _row(tree: T, index: int) -> T:
    """Select one row of every array, in one program."""
    return jax.tree.map(lambda x: x[index], tree)
