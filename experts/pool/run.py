"""From levels to verdicts: decide levels that need no expert; search, train and judge the others."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS, ExpertConfig, Rule
from levelproof.experts.labels import WITNESSED, Source, Verdict
from levelproof.experts.ledger import Lap, Ledger, lap
from levelproof.experts.pool.found import SearchFindings, findings_of, joined
from levelproof.experts.pool.paused import Paused
from levelproof.experts.pool.pool import NONE_PAUSED, NOTHING_BEGUN, Pool, TrainingJob
from levelproof.experts.pool.rework import rework
from levelproof.experts.steps import EnvSteps, Totals
from levelproof.experts.verdict.afresh import attempt
from levelproof.experts.verdict.before import decide
from levelproof.experts.verdict.judge import KeptExpert, TrainedLevel, Witness, judge, repeating
from levelproof.experts.verdict.portability import choose
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import Record, replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.identity.keys import level_id_array
from levelproof.levelgen.level import ACTIONS, Level


@dataclass(frozen=True)
class UnitResult:
    """Results of some levels, on the host, in the order of `level_ids`."""

    level_ids: Int[np.ndarray, " level"]
    levels: Level
    record: Record  # all zero if the level has no witness
    verdicts: list[Verdict]
    spent: EnvSteps
    experts: dict[int, KeptExpert] = field(default_factory=dict)  # by level id, if they are kept
    ledger: Ledger | None = None  # None: not measured


class TrainingRun:
    """Levels on their way to verdicts: decided at once, or searched, then trained in a pool shared with other runs."""

    def __init__(
        self,
        pool: Pool,
        levels: Level,
        level_ids: np.ndarray,
        begun: Mapping[int, KeptExpert] = NOTHING_BEGUN,
        keep: bool = False,
        ledger: Ledger | None = None,
        paused: Mapping[int, Paused] = NONE_PAUSED,
    ) -> None:
        """
        Args:
            pool: pool in which experts train.
            levels: the levels, as their ids rebuild them.
            level_ids: their ids; the seeds of all randomness.
            begun: by level id, experts of a smaller budget to continue; the other levels get new ones.
            keep: whether to return the experts.
            ledger: costs of the levels so far.
            paused: by level id, interrupted experts of this budget to resume; their levels are not searched again.
        """
        self.ledger = ledger or Ledger(len(level_ids))
        self.pool, self.level_ids, self._begun, self._keep = pool, level_id_array(level_ids), begun, keep
        with self.ledger.timing("sampling"):
            self.levels: Level = jax.tree.map(np.asarray, levels)
            self.before = decide(self.levels, pool.rules)
        self.left = np.array([i for i, verdict in enumerate(self.before.verdicts) if verdict is None], int)
        self._paused = {i: paused[i] for i in self.level_ids[self.left].tolist() if i in paused}
        new = ~np.isin(self.level_ids[self.left], list(self._paused))
        self._order = np.argsort(
            np.r_[np.flatnonzero(new), np.flatnonzero(~new)]
        )  # index of each level of `left` among the new levels followed by the resumed ones
        with self.ledger.timing("search"):
            self._searched = self.left[new]
            self.search = pool.searching.submit(*self._some(self._searched))
        self.submission: TrainingJob | None = None  # of levels that need an expert
        self._left_out: set[int] = set()  # ids of levels that other workers label
        self.submit_searched()

    def submit_searched(self) -> None:
        """Submit the levels to the pool once their search has ended."""
        if self.submission or self.search.under_way:
            return
        with self.ledger.timing("search"):
            findings = findings_of(self.pool.searching.result(self.search))
        self.ledger.take(self.search.ledger, self._searched)
        some = self.left if self.pool.procedure.stop.rule != Rule.NONE else self.left[:0]
        levels, level_ids = self._some(some)
        among = lambda known: {i: known[one] for i, one in enumerate(level_ids.tolist()) if one in known}
        findings = joined([findings, *(one.found for one in self._paused.values())], self._order)
        self.submission = self.pool.submit(
            levels, level_ids, findings, among(self._begun), self._keep, among(self._paused)
        )
        if self._left_out:
            self.leave_out(self._left_out)

    @property
    def searching(self) -> int:
        """Number of levels that will come to the pool."""
        return 0 if self.submission else len(self.left) - len(self._left_out)

    @property
    def unbegun(self) -> list[int]:
        """Ids of levels that wait for their search, or for a slot."""
        if self.submission is None:
            waiting = self.search.level_ids[self.pool.searching.waiting(self.search)]
        else:
            waiting = self.submission.level_ids[self.pool.waiting(self.submission)]
        return [level_id for level_id in waiting.tolist() if level_id not in self._paused]

    def paused(self, in_slots: Iterable[tuple[TrainingJob, int, Paused]]) -> dict[int, Paused]:
        """Return the run's unfinished experts by level id: its own among `in_slots`, and those that wait."""
        undecided = set(self.undecided)
        waiting = {level_id: paused for level_id, paused in self._paused.items() if level_id in undecided}
        return waiting | {
            int(self.level_ids[self.left[i]]): paused
            for submission, i, paused in in_slots
            if submission is self.submission
        }

    @property
    def undecided(self) -> list[int]:
        """Ids of levels that wait for an expert or have one; all ids until the search has ended."""
        submission = self.submission
        return (submission.level_ids[sorted(submission.under_way)] if submission else self.level_ids).tolist()

    def leave_out(self, level_ids: Collection[int]) -> None:
        """Leave levels to other workers: any of those `unbegun`, or all `undecided` when this worker stops."""
        self._left_out.update(level_ids)
        indices = lambda ids: np.flatnonzero(np.isin(ids, list(self._left_out)))
        if self.submission is None:
            self.pool.searching.withdraw(self.search, indices(self.search.level_ids).tolist())
        else:
            self.pool.withdraw(self.submission, indices(self.submission.level_ids).tolist())

    def totals(self) -> Totals:
        """Return the progress of all levels, including those that need no expert."""
        searched = self.search.env_steps
        if self.submission is None:
            return Totals(searched, len(self.level_ids) - len(self.left), 0)
        now, waiting = self.pool.totals(self.submission), len(self.submission.level_ids)
        others = len(self.level_ids) - waiting - len(self._left_out)
        return now._replace(env_steps=now.env_steps + searched, levels=others + now.levels)

    def finish(self) -> UnitResult:
        """Choose witnesses and return verdicts, once the submission has finished; omit levels left to other workers."""
        submission = self.submission
        assert submission is not None
        trained = submission.trained(self.pool.config) if len(submission.level_ids) else as_found(submission.found)
        attempted = self._attempted(trained)
        with lap() as took:
            result, reworking = self._judged(submission, trained, attempted)
        searched = np.zeros(len(self.level_ids), np.int64)
        searched[self.left] = submission.found.search_steps
        searched[np.isin(self.level_ids, list(self._paused))] = 0  # an earlier process searched these
        self.ledger.share("search", searched)
        for level, seconds in reworking.items():
            self.ledger.put("search", level, seconds)
        if len(submission.level_ids):
            self.ledger.take(submission.ledger, self.left)
        ledger = self.ledger.only(np.flatnonzero(np.isin(self.level_ids, result.level_ids)))
        ledger.add("replay", Lap(max(0.0, took.seconds - sum(reworking.values())), took.compiling))
        return replace(result, ledger=ledger)

    def _attempted(self, trained: Sequence[TrainedLevel]) -> dict[int, tuple[float, int]]:
        """Measure experts' success rates; return (rate, env steps it took) by index into `left`."""
        policies = {
            i: level.policy
            for i, (index, level) in enumerate(zip(self.left, trained, strict=True))
            if level.policy is not None and int(self.level_ids[index]) not in self._left_out
        }
        with lap() as took:
            at = self.left[list(policies)]
            results = attempt(*self._some(at), list(policies.values()), self.pool.config, self.pool.rules)
        self.ledger.add("evaluation", Lap(0.0, took.compiling))
        for level in at:
            self.ledger.put("evaluation", level, took.seconds / len(at))
        return dict(zip(policies, zip(*(x.tolist() for x in results), strict=True), strict=True))

    def _judged(
        self, submission: TrainingJob, trained: list[TrainedLevel], attempted: Mapping[int, tuple[float, int]]
    ) -> tuple[UnitResult, dict[int, float]]:
        """Return the results, and the seconds of rework by index into `level_ids`, in proportion to env steps."""
        config, rules = self.pool.config, self.pool.rules
        kept = np.flatnonzero(~np.isin(self.level_ids, list(self._left_out)))
        levels, level_ids = self._some(kept)
        before, failed = [self.before.verdicts[i] for i in kept], self.before.failed_by_noop[kept]
        findings = submission.found
        submitted = np.flatnonzero(np.isin(self.left, kept))  # indices among the submitted levels
        left = np.searchsorted(kept, self.left[submitted])
        trained = [trained[i] for i in submitted]
        actions = np.zeros((RECORD_STEPS, ACTIONS, len(kept)), np.int32)  # a level without a witness does nothing
        candidates = [idling(verdict, actions[..., i]) if verdict else () for i, verdict in enumerate(before)]
        for i, level in zip(left, trained, strict=True):
            candidates[i] = level.candidates
        chosen = choose(levels, level_ids, candidates, config.replays, rules)
        with lap() as took:
            chosen, reworked = rework(levels, level_ids, chosen, self.pool.procedure, rules)
        reworking = {int(kept[i]): took.seconds * reworked[i] / reworked.sum() for i in np.flatnonzero(reworked)}
        for i, witness in enumerate(chosen):
            if witness is not None:
                actions[..., i] = witness.action
        record = replay(levels, actions, rules)
        witnesses = [chosen[i] for i in left]
        judged = judge(trained, witnesses, take(record, left), config, failed[left])
        verdicts = {
            i: with_search(with_attempts(verdict, attempted.get(at)), findings, at, int(reworked[i]))
            for i, verdict, at in zip(left.tolist(), judged, submitted.tolist(), strict=True)
        }
        shares = [None if witness is None else witness.portability for witness in chosen]
        known = [
            replace(verdict, portability=share) if verdict else verdicts[i]
            for i, (verdict, share) in enumerate(zip(before, shares, strict=True))
        ]
        witnessed = np.array([verdict.label in WITNESSED for verdict in known])
        record = jax.tree.map(lambda x: np.where(witnessed, x, np.zeros_like(x)), record)
        ended = zip(level_ids[left].tolist(), trained, strict=True)
        experts = {level_id: level.expert for level_id, level in ended if level.expert is not None}
        here = set(level_ids.tolist())
        earlier = [paused for level_id, paused in self._paused.items() if level_id in here]
        spent = spent_on(known, submission, config, earlier)
        return UnitResult(level_ids, levels, record, known, spent, experts), reworking

    def _some(self, indices: Int[np.ndarray, " index"]) -> tuple[Level, Int[np.ndarray, " index"]]:
        return take(self.levels, indices), self.level_ids[indices]


def with_attempts(verdict: Verdict, attempted: tuple[float, int] | None) -> Verdict:
    """Add the success rate of the expert's attempts, and their env steps, if it made any."""
    if attempted is None:
        return verdict
    rate, env_steps = attempted
    return replace(verdict, success_rate=rate, evaluation_steps=verdict.evaluation_steps + env_steps)


def with_search(verdict: Verdict, findings: SearchFindings, index: int, reworked: int) -> Verdict:
    """Add results of the search before training, and the env steps of rework."""
    searched = int(findings.search_steps[index])
    return replace(
        verdict,
        search_steps=searched + reworked,
        cells=int(findings.cells[index]) if searched else None,
        still_grew=bool(findings.still_grew[index]) if searched else None,
    )


def as_found(findings: SearchFindings) -> list[TrainedLevel]:
    """Wrap levels without an expert: their candidates are the successes of the search."""
    each = zip(findings.success.action, findings.success.length, findings.source, strict=True)
    return [
        TrainedLevel([], [], candidates=repeating(Success(action, length), source)) for action, length, source in each
    ]


def idling(verdict: Verdict, nothing: Int[np.ndarray, "256 6"]) -> Sequence[Witness]:
    """Return the witness of a level that needs no expert, if any: doing nothing."""
    steps = verdict.steps_to_goal
    return () if steps is None else (Witness(nothing, Source.NOTHING, steps),)


def spent_on(
    verdicts: list[Verdict], submission: TrainingJob, config: ExpertConfig, earlier: Sequence[Paused]
) -> EnvSteps:
    """Sum the env steps of levels, and of empty slots, without those that `earlier` processes took."""
    total = lambda name: sum(getattr(verdict, name) for verdict in verdicts)
    evaluated = sum(paused.evaluated_rollouts for paused in earlier)
    return EnvSteps(
        total("search_steps") - sum(int(paused.found.search_steps.sum()) for paused in earlier),
        submission.trained_rollouts * config.steps_per_update,
        total("evaluation_steps") - evaluated * config.steps_per_update,
        submission.idle_rollouts * config.steps_per_update,
    )
