"""From what training and evaluation showed of a level to its witness and its verdict."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.config import RECORD_STEPS, Choice, ExpertConfig
from levelproof.experts.labels import (
    UNTRAINED,
    Cause,
    Label,
    Source,
    Verdict,
    solved_reason,
    unsolved_reason,
    untrained,
)
from levelproof.experts.policy import Params
from levelproof.experts.training.progress import NEVER, Progress
from levelproof.experts.training.slots import ExpertState
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import Record, steps_to_goal, succeeds

MAX_CANDIDATES = 16  # of an evaluation


class Evaluation(NamedTuple):
    """One evaluation, on the host; environments in the order of `experts.training.advance._manner`."""

    action: Int[np.ndarray, "256 6 attempt"]
    done: Bool[np.ndarray, "256 environment"]
    goal: Bool[np.ndarray, "256 environment"]
    progress: Progress  # of training until then
    success: Success  # the first: the search's, else training's
    over: int | Int[np.ndarray, ""] | Int[Array, ""]  # the Cause for which training stopped for good


class KeptExpert(NamedTuple):
    """An expert that can go on later."""

    begun: ExpertState
    curve: list[float]  # so far, as in `TrainedLevel`


class Witness(NamedTuple):
    """Actions that reach the goal."""

    action: Int[np.ndarray, "256 6"]
    source: Source
    steps: int  # of the first episode
    portability: float | None = None  # as in `Verdict`; None: not known


class TrainedLevel(NamedTuple):
    """A level that has left its slot."""

    curve: list[float]  # per update: share of finished episodes that reached the goal; NaN: none finished
    evaluations: list[Evaluation]  # those that solved it, and the last
    expert: KeptExpert | None = None  # if it is kept
    candidates: Sequence[Witness] = ()  # for its witness, the shortest first; some have been replayed
    evaluation_steps: int = 0  # env steps
    policy: Params | None = None  # of the expert that left; None: there was none


def judge(
    trained: Sequence[TrainedLevel],
    chosen: Sequence[Witness | None],
    record: Record,
    config: ExpertConfig,
    failed_by_noop: Bool[np.ndarray, " level"],
) -> list[Verdict]:
    """Verdicts. A witness counts only if its record, by replay, shows what the evaluation showed.

    `chosen` are the witnesses, not yet replayed.
    """
    replays, steps = succeeds(record.done, record.goal), steps_to_goal(record.done)
    verdicts = []
    for i, (of, choice) in enumerate(zip(trained, chosen, strict=True)):
        counts = choice is not None and replays[i] and steps[i] == choice.steps
        witness = choice if counts else None
        episodes = int(record.done[:, i].sum())
        verdicts.append(verdict_of(of, witness, episodes, config, bool(failed_by_noop[i])))
    return verdicts


def candidates_of(evaluations: Sequence[Evaluation], source: Source, config: ExpertConfig) -> list[Witness]:
    """What could be a level's witness: successes of its evaluations, the shortest first.

    Without one, the success that was rehearsed, which is of this source.
    """
    found = [witness for e in evaluations for witness in witnesses_in(e, config)]
    if not found and config.exploration:
        return repeating(evaluations[-1].success, source)
    return shortest_first(found)


def shortest_first(witnesses: Iterable[Witness]) -> list[Witness]:
    """Of equals the first stays the first."""
    return sorted(witnesses, key=lambda witness: witness.steps)


def repeating(success: Success, source: Source) -> list[Witness]:
    """A success again and again, if there is one."""
    steps = int(success.length)
    return [Witness(repeated(np.asarray(success.action), steps), source, steps)] if steps else []


def witnesses_in(evaluation: Evaluation, config: ExpertConfig) -> list[Witness]:
    """Witnesses of an evaluation, the shortest ones; where none is replayed from moved starts, one."""
    attempts = evaluation.action.shape[-1]
    done, goal = evaluation.done[:, :attempts], evaluation.goal[:, :attempts]
    source = lambda attempt: Source.SAMPLED if attempt else Source.MOST_PROBABLE
    if config.witness == Choice.RECORD:
        steps, usable = steps_to_goal(done), np.flatnonzero(succeeds(done, goal))
        usable = usable[np.argsort(steps[usable], kind="stable")][:MAX_CANDIDATES] if config.replays else usable[:1]
        return [Witness(evaluation.action[..., i], source(i), int(steps[i])) for i in usable]
    episodes = [(end - start, attempt, start) for attempt in range(attempts)
                for start, end in successful_episodes(done[:, attempt], goal[:, attempt])]  # fmt: skip
    played = lambda steps, attempt, start: evaluation.action[start : start + steps, :, attempt]
    distinct = {played(*episode).tobytes(): episode for episode in sorted(episodes, reverse=True)}  # the first stays
    shortest = sorted(distinct.values())[: MAX_CANDIDATES if config.replays else 1]
    return [Witness(repeated(played(*episode), episode[0]), source(episode[1]), episode[0]) for episode in shortest]


def successful_episodes(done: Bool[np.ndarray, " time"], goal: Bool[np.ndarray, " time"]) -> list[tuple[int, int]]:
    """First step and the step after the last of every episode that reached the goal."""
    ends = np.flatnonzero(done) + 1
    return [(int(start), int(end)) for start, end in pairwise([0, *ends]) if goal[end - 1]]


def repeated(action: Int[np.ndarray, "time 6"], steps: int) -> Int[np.ndarray, "256 6"]:
    """An episode's actions again and again: the world starts anew after each, so each reaches the goal."""
    return np.asarray(action, np.int32)[np.arange(RECORD_STEPS) % steps]


def verdict_of(
    trained: TrainedLevel,
    witness: Witness | None,
    episodes: int,
    config: ExpertConfig,
    failed_by_noop: bool,
) -> Verdict:
    """A level's verdict: `episodes` are those of its record."""
    if not trained.evaluations:
        if witness is None:
            return untrained(Label.UNSOLVED, UNTRAINED, failed_by_noop)
        _, source, steps, portability = witness
        reason = solved_reason(source, episodes)
        return untrained(Label.SOLVED, reason, failed_by_noop, source, steps, portability)
    last = trained.evaluations[-1]
    attempts, sticky, moved = shares(last, config)
    first, env_steps = (int(x) for x in (last.progress.first_success, last.progress.env_steps))
    if witness is not None:
        reason = solved_reason(witness.source, episodes)
    else:
        reason = unsolved_reason(config.attempts, first != NEVER, Cause(int(last.over)), env_steps)
    return Verdict(
        label=Label.UNSOLVED if witness is None else Label.SOLVED,
        label_reason=reason,
        failed_by_noop=failed_by_noop,
        witness=None if witness is None else witness.source,
        success_rate=attempts,
        most_probable_succeeds=bool(succeeds(last.done[:, 0], last.goal[:, 0])),
        sticky_success_rate=sticky,
        moved_success_rate=moved,
        steps_to_goal=None if witness is None else witness.steps,
        steps_to_first_success=None if first == NEVER else first,
        env_steps=env_steps,
        portability=None if witness is None else witness.portability,
        evaluation_steps=trained.evaluation_steps,
        learning_curve=trained.curve,
        best_return=float(last.progress.best_return),
        episodes=int(last.progress.episodes),
    )


def shares(evaluation: Evaluation, config: ExpertConfig) -> tuple[float, float, float]:
    """Success rates of sampled, of sticky and of moved attempts: of their first episodes.

    Episodes after the first would count quick successes several times and slow failures never; and only a first one
    starts with other velocities. One that has not ended within the record did not succeed. NaN: no such attempts.
    """
    done, goal = evaluation.done, evaluation.goal
    first = done.any(0) & goal[np.argmax(done, 0), np.arange(done.shape[1])]
    sampled = first[1 : config.attempts]  # the first is the most probable one
    sticky = first[config.attempts : config.attempts + config.sticky_attempts]
    moved = first[config.attempts + config.sticky_attempts :][: config.moved_attempts]
    mean = lambda x: float(x.mean()) if len(x) else float("nan")
    return mean(sampled), mean(sticky), mean(moved)
