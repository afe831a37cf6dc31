"""Choice of a level's witness candidates, and its verdict, from its training and evaluations."""

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

MAX_CANDIDATES = 16  # per evaluation


class Evaluation(NamedTuple):
    """One evaluation, on the host; environments in the order of `experts.training.advance._manner`."""

    action: Int[np.ndarray, "256 6 attempt"]
    done: Bool[np.ndarray, "256 environment"]
    goal: Bool[np.ndarray, "256 environment"]
    progress: Progress  # of training before it
    success: Success  # the first, of the search or of training
    over: int | Int[np.ndarray, ""] | Int[Array, ""]  # Cause why training stopped for good


class KeptExpert(NamedTuple):
    """An expert that a larger budget can continue."""

    begun: ExpertState
    curve: list[float]  # as in `TrainedLevel`


class Witness(NamedTuple):
    """Actions that reach the goal."""

    action: Int[np.ndarray, "256 6"]
    source: Source
    steps: int  # of the first episode
    portability: float | None = None  # as in `Verdict`; None: unknown


class TrainedLevel(NamedTuple):
    """A level that has left its slot."""

    curve: list[float]  # per update: share of finished episodes that reached the goal; NaN: none finished
    evaluations: list[Evaluation]  # evaluations that solved the level, and the last one
    expert: KeptExpert | None = None  # if kept
    candidates: Sequence[Witness] = ()  # possible witnesses, shortest first; some have been replayed
    evaluation_steps: int = 0  # env steps
    policy: Params | None = None  # parameters of its expert; None: no expert


def judge(
    trained: Sequence[TrainedLevel],
    chosen: Sequence[Witness | None],
    record: Record,
    config: ExpertConfig,
    failed_by_noop: Bool[np.ndarray, " level"],
) -> list[Verdict]:
    """Return verdicts. A witness counts only if its replay, `record`, reaches the goal in the same number of env steps.

    `chosen` are the witnesses before replay.
    """
    replays, steps = succeeds(record.done, record.goal), steps_to_goal(record.done)
    verdicts = []
    for i, (level, choice) in enumerate(zip(trained, chosen, strict=True)):
        counts = choice is not None and replays[i] and steps[i] == choice.steps
        witness = choice if counts else None
        episodes = int(record.done[:, i].sum())
        verdicts.append(verdict_of(level, witness, episodes, config, bool(failed_by_noop[i])))
    return verdicts


def candidates_of(evaluations: Sequence[Evaluation], source: Source, config: ExpertConfig) -> list[Witness]:
    """Return candidates for a level's witness: successes of its evaluations, shortest first.

    If there are none, the candidate is the rehearsed success, which comes from `source`.
    """
    witnesses = [witness for e in evaluations for witness in witnesses_in(e, config)]
    if not witnesses and config.exploration:
        return repeating(evaluations[-1].success, source)
    return shortest_first(witnesses)


def shortest_first(witnesses: Iterable[Witness]) -> list[Witness]:
    """Sort witnesses by length; the sort is stable."""
    return sorted(witnesses, key=lambda witness: witness.steps)


def repeating(success: Success, source: Source) -> list[Witness]:
    """Return a witness that repeats the success, if there is one."""
    steps = int(success.length)
    return [Witness(repeated(np.asarray(success.action), steps), source, steps)] if steps else []


def witnesses_in(evaluation: Evaluation, config: ExpertConfig) -> list[Witness]:
    """Return an evaluation's shortest witnesses; only one if `expert.replays` is 0."""
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
    distinct = {
        played(*episode).tobytes(): episode for episode in sorted(episodes, reverse=True)
    }  # reversed, so that the first of equal episodes is kept
    shortest = sorted(distinct.values())[: MAX_CANDIDATES if config.replays else 1]
    return [
        Witness(repeated(played(steps, attempt, start), steps), source(attempt), steps)
        for steps, attempt, start in shortest
    ]


def successful_episodes(done: Bool[np.ndarray, " time"], goal: Bool[np.ndarray, " time"]) -> list[tuple[int, int]]:
    """Return [start, end) of every episode that reached the goal."""
    ends = np.flatnonzero(done) + 1
    return [(int(start), int(end)) for start, end in pairwise([0, *ends]) if goal[end - 1]]


def repeated(action: Int[np.ndarray, "time 6"], steps: int) -> Int[np.ndarray, "256 6"]:
    """Repeat an episode's actions: the world is reset after each episode, so each reaches the goal."""
    return np.asarray(action, np.int32)[np.arange(RECORD_STEPS) % steps]


def verdict_of(
    trained: TrainedLevel,
    witness: Witness | None,
    episodes: int,
    config: ExpertConfig,
    failed_by_noop: bool,
) -> Verdict:
    """Return a level's verdict; `episodes` counts the finished episodes of its record."""
    if not trained.evaluations:
        if witness is None:
            return untrained(Label.UNSOLVED, UNTRAINED, failed_by_noop)
        _, source, steps, portability = witness
        reason = solved_reason(source, episodes)
        return untrained(Label.SOLVED, reason, failed_by_noop, source, steps, portability)
    last = trained.evaluations[-1]
    attempts, sticky, perturbed = shares(last, config)
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
        perturbed_success_rate=perturbed,
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
    """Return success rates of sampled, sticky and perturbed attempts over first episodes (NaN: no such attempts).

    Later episodes would count quick successes several times and slow failures never, and do not start with perturbed
    velocities. An episode that does not end within the record is a failure.
    """
    done, goal = evaluation.done, evaluation.goal
    first = done.any(0) & goal[np.argmax(done, 0), np.arange(done.shape[1])]
    sampled = first[1 : config.attempts]  # the first takes the most probable actions
    sticky = first[config.attempts : config.attempts + config.sticky_attempts]
    perturbed = first[config.attempts + config.sticky_attempts :][: config.perturbed_attempts]
    mean = lambda x: float(x.mean()) if len(x) else float("nan")
    return mean(sampled), mean(sticky), mean(perturbed)
