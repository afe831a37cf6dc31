"""A worker's pool: levels are searched, wait in the queue, train in slots, and leave.

Levels are submitted together and finish together; submissions share the slots. A level's result depends on that level
alone, so sharing changes no result.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.batcher import Batcher, Entrant, Submission, levels_of
from levelproof.experts.config import RECORD_STEPS, ExpertConfig, check_budget
from levelproof.experts.ledger import Lap, StepCosts, lap
from levelproof.experts.policy import Params
from levelproof.experts.pool.found import SearchFindings, nothing_found, row_of
from levelproof.experts.pool.paused import Paused
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.search import Searching
from levelproof.experts.steps import Totals
from levelproof.experts.training.advance import advance, train_on
from levelproof.experts.training.slots import ExpertState, Mode, Pending, Report, Slots, begin, slots_of
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
from levelproof.levelgen.batching import at_once, stacked
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

GROUP = 16  # experts that begin together; another number would change the bits of their initial weights
IN_CACHE = 128  # lanes: their physics and one minibatch fit the cache of a core
T = TypeVar("T")
NOTHING_BEGUN: Mapping[int, KeptExpert] = MappingProxyType({})
NONE_PAUSED: Mapping[int, Paused] = MappingProxyType({})


class TrainingJob(Submission):
    """Levels that train, and the results of each so far. Arguments as in `Pool.submit`."""

    def __init__(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        found: SearchFindings,
        begun: Mapping[int, KeptExpert],
        keep: bool,
        paused: Mapping[int, Paused],
    ) -> None:
        super().__init__(levels, level_ids)
        count = len(level_ids)
        self.found, self.keep, self.paused = found, keep, paused
        self.begun = {**begun, **{i: expert.expert for i, expert in paused.items()}}
        self.curves = [list(self.begun[i].curve) if i in self.begun else [] for i in range(count)]
        self.evaluations = [list(paused[i].evaluations) if i in paused else [] for i in range(count)]
        self.experts: list[KeptExpert | None] = [None] * count
        self.candidates: list[list[Witness]] = [[] for _ in range(count)]
        self.policies: list[Params | None] = [None] * count
        self.solved = 0
        self.trained_rollouts = self.idle_rollouts = 0
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
        self.stopping = rules_of(procedure.stop, self.config)
        self.shaped = replace(rules, dense_reward_scale=self.config.dense_reward_scale)
        self._slots = Batcher(slot_count(self.config), GROUP)
        self._submissions: list[TrainingJob] = []  # unfinished
        self._steps = StepCosts()

    def submit(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        found: SearchFindings | None = None,
        begun: Mapping[int, KeptExpert] = NOTHING_BEGUN,
        keep: bool = False,
        paused: Mapping[int, Paused] = NONE_PAUSED,
    ) -> TrainingJob:
        """Queue levels for slots: each trains in one until it is decided or has used its budget.

        Args:
            levels: the levels, on the host.
            level_ids: their ids.
            found: search results, whose successes their experts rehearse from the start; None: none.
            begun: earlier experts to continue, by index among the levels.
            keep: whether to return the experts.
            paused: interrupted experts to resume, by index among the levels.
        """
        submission = TrainingJob(levels, level_ids, found or nothing_found(len(level_ids)), begun, keep, paused)
        self._submissions.append(submission)
        self._slots.submit(submission)
        return submission

    def step(self) -> list[TrainingJob]:
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

        `searched` levels are in the search or wait for it; all of them may need a slot.
        """
        return max(self._short - searched, self.searching.wants, 0)

    @property
    def _short(self) -> int:
        """Number of levels missing until as many wait as there are slots."""
        return max(0, self._slots.width - len(self._slots.waiting))

    def waiting(self, submission: TrainingJob) -> list[int]:
        """Return indices of the submission's levels that have had no slot, ascending."""
        return self._slots.waiting_of(submission)

    def withdraw(self, submission: TrainingJob, indices: Collection[int]) -> None:
        """Remove levels from the queue; those in slots no longer count as under way."""
        self._slots.withdraw(submission, indices)

    def totals(self, submission: TrainingJob) -> Totals:
        """Return the progress of a submission."""
        parts = sum(len(submission.curves[i]) for i in submission.under_way) / self.updates
        steps = submission.trained_rollouts * self.config.steps_per_update
        decided = len(submission.curves) - len(submission.under_way)
        return Totals(steps, decided + parts, submission.solved)

    def paused(self) -> Iterator[tuple[TrainingJob, int, Paused]]:
        """Yield every expert in a slot, ready to resume, with its submission and index there."""
        if not self._slots.at:
            return
        slot = self._slots.rows.slot
        now = jax.device_get((slot.mode, slot.trial.part, slot.deadline, slot.trial.due, slot.trial.final))
        for number, (submission, i, _) in self._slots.busy():
            mode, part, deadline, due, final = (x[number] for x in now)
            evaluating = mode == Mode.EVALUATE
            yield (
                submission,
                i,
                Paused(
                    KeptExpert(expert_of(self._slots.rows, number), list(submission.curves[i])),
                    Pending(evaluating & due, evaluating & final, deadline),
                    int(submission.evaluated_rollouts[i]) - (int(part) if evaluating else 0),
                    list(submission.evaluations[i]),
                    row_of(submission.found, i),
                ),
            )

    def _advance(self) -> None:
        """Advance every slot by a rollout, and charge its time to the levels."""
        slots = self._slots
        with lap() as took:
            slots.fill(self._begin)
            slots.rows, report = advance(slots.rows, self.config, self.stopping, self.shaped)
            report, busy = jax.device_get(report), slots.busy()
            for slot, (submission, i, _) in busy:
                self._note(slot, report, submission, i)
        self._leave(report, {slot: entrant for slot, entrant in busy if report.left[slot]})
        trains = [bool(report.mode[slot] == Mode.TRAIN) for slot, _ in busy]
        training, evaluation = self._steps.split(took.seconds, sum(trains), slots.width)
        for train, (_, (submission, i, _)) in zip(trains, busy, strict=True):
            submission.ledger.put(*(("training", i, training) if train else ("evaluation", i, evaluation)))
        # charge empty slots to one submission, so that they count once, and to one that has levels
        idle, last = slots.width - len(busy), busy[-1][1].submission if busy else self._submissions[-1]
        last.idle_rollouts += idle
        last.ledger.add("idle", Lap(evaluation * idle, took.compiling))

    def _begin(self, levels: Level, level_ids: Int[np.ndarray, " level"], entrants: list[Entrant]) -> Slots:
        """Return slots with new experts, or with those that continue."""
        count = len(entrants)
        success = [jax.tree.map(lambda x, i=i: x[i], submission.found.success) for submission, i, _ in entrants]
        fresh = begin(levels, level_ids, stacked(success), self.config)
        no = np.zeros(count, bool)
        experts = fresh, Pending(no, no, np.full(count, self.updates, np.int32))
        continued = {row: (submission, i) for row, (submission, i, _) in enumerate(entrants) if i in submission.begun}
        if continued:
            experts = jax.tree.map(np.array, experts)
        for row, (submission, i) in continued.items():
            pending = submission.paused[i].pending if i in submission.paused else (False, False, self.updates)
            expert = submission.begun[i].begun, pending
            for rows, one in zip(jax.tree.leaves(experts), jax.tree.leaves(expert), strict=True):
                rows[row] = one
        return slots_of(levels, level_ids, *experts, self.config)

    def _note(self, slot: int, report: Report, submission: TrainingJob, i: int) -> None:
        """Record what happened to a level in its slot."""
        if report.mode[slot] == Mode.TRAIN:
            submission.trained_rollouts += 1
            submission.curves[i].append(float(report.share[slot]))
        else:
            submission.evaluated_rollouts[i] += 1
        if report.evaluated[slot]:
            submission.evaluations[i].append(evaluation_of(self._slots.rows, slot))

    def _leave(self, report: Report, levels: Mapping[int, Entrant]) -> None:
        """Release finished levels from their slots; early leavers with a fragile witness train on."""
        slots = self._slots
        for submission, i, _ in levels.values():
            submission.candidates[i] = self._candidates(submission, i)
        stay = self._fragile({slot: entrant for slot, entrant in levels.items() if report.early[slot]})
        for slot, (submission, i, _) in levels.items():
            if slot in stay:
                continue
            if submission.keep:
                submission.experts[i] = KeptExpert(expert_of(slots.rows, slot), submission.curves[i])
            submission.policies[i] = jax.device_get(_row(slots.rows.slot.training.train_state.params, slot))
            submission.solved += bool(submission.candidates[i])
            del slots.at[slot]
            submission.under_way.remove(i)
        if stay:
            slots.rows = train_on(slots.rows, np.isin(np.arange(slots.width), stay), self.stopping)

    def _candidates(self, submission: TrainingJob, i: int) -> list[Witness]:
        """Return candidates for a level's witness: the best so far, if already chosen, and the last evaluation's."""
        evaluations, best = submission.evaluations[i], submission.candidates[i]
        if best:
            return shortest_first([*best, *witnesses_in(evaluations[-1], self.config)])
        return candidates_of(evaluations, submission.found.source[i], self.config)

    def _fragile(self, solved: Mapping[int, Entrant]) -> list[int]:
        """Return slots of solved levels without a portable witness; each level keeps its best candidate."""
        if not (solved and self.procedure.stop.robustness and self.config.replays):
            return []
        with lap() as took:
            candidates = [submission.candidates[i] for submission, i, _ in solved.values()]
            best = choose(*levels_of([*solved.values()]), candidates, self.config.replays, self.rules)
        slots = []
        for (slot, (submission, i, _)), witness in zip(solved.items(), best, strict=True):
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


def expert_of(slots: Slots, slot: int) -> ExpertState:
    """Copy the expert in a slot, or that has just left it, to the host, ready to continue."""
    return jax.device_get(_row(ExpertState(slots.slot.training, slots.acting), slot))


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
