"""Choice of witness candidates, and statistics of evaluations."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from levelproof.experts.config import RECORD_STEPS, Choice, ExpertConfig
from levelproof.experts.labels import Cause, Label, Source
from levelproof.experts.training import progress
from levelproof.experts.verdict.judge import (
    MAX_CANDIDATES,
    Evaluation,
    TrainedLevel,
    Witness,
    candidates_of,
    judge,
    repeated,
    shares,
    successful_episodes,
)
from levelproof.experts.witness.success import Success

CONFIG = ExpertConfig(environments=8, rehearsals=2, attempts=3, sticky_attempts=2, perturbed_attempts=2)


def evaluation(*episodes: list[tuple[int, bool]], success: int = 0, config: ExpertConfig = CONFIG) -> Evaluation:
    """Return an evaluation with these episodes: (last step, whether it reached the goal). Actions count the steps."""
    done, goal = np.zeros((2, RECORD_STEPS, config.environments), bool)
    for environment, ends in enumerate(episodes):
        for end, reached in ends:
            done[end, environment], goal[end, environment] = True, reached
    action = np.arange(RECORD_STEPS)[:, None, None] + 1000 * np.arange(config.attempts) + np.zeros((1, 6, 1), int)
    played = Success(np.full((RECORD_STEPS, 6), 7, np.int8), np.int32(success))
    return Evaluation(action, done, goal, progress.start(config.environments), played, np.int8(Cause.NONE))


def best_of(evaluations: list[Evaluation], source: Source, config: ExpertConfig) -> Witness | None:
    return next(iter(candidates_of(evaluations, source, config)), None)


def test_witness_counts_only_if_its_replay_takes_as_many_steps() -> None:
    """A replay that reaches the goal earlier or later, or not at all, solves nothing, nor does a missing witness."""
    done, goal = np.zeros((2, RECORD_STEPS, 5), bool)
    done[9] = goal[9] = True
    goal[9, 3] = False
    record: Any = SimpleNamespace(done=done, goal=goal)
    witness = lambda steps: Witness(np.zeros((RECORD_STEPS, 6), int), Source.SAMPLED, steps)
    chosen = [witness(10), witness(9), witness(11), witness(10), None]
    trained = [TrainedLevel([], [evaluation([(9, True)])])] * 5
    verdicts = judge(trained, chosen, record, CONFIG, np.array([True, False, True, False, True]))
    assert [verdict.label for verdict in verdicts] == [Label.SOLVED, *[Label.UNSOLVED] * 4]
    assert [verdict.steps_to_goal for verdict in verdicts] == [10, *[None] * 4]
    assert [verdict.failed_by_noop for verdict in verdicts] == [True, False, True, False, True]


def test_best_witness_is_the_first_attempt_without_failure() -> None:
    one = evaluation([(9, True), (20, False)], [(99, True), (199, True)], [(30, True)])
    witness = best_of([one], Source.SEARCH, replace(CONFIG, replays=0))
    assert witness is not None
    assert (witness.source, witness.steps) == (Source.SAMPLED, 100)
    np.testing.assert_array_equal(witness.action[:, 0], np.arange(RECORD_STEPS) + 1000)


def test_choice_shortest_repeats_the_shortest_success() -> None:
    one = evaluation([(9, True), (14, True), (20, False)], [(99, True)], [(30, True)])
    witness = best_of([one], Source.SEARCH, replace(CONFIG, witness=Choice.SHORTEST))
    assert witness is not None
    assert (witness.source, witness.steps) == (Source.MOST_PROBABLE, 5)
    np.testing.assert_array_equal(witness.action[:12, 0], [10, 11, 12, 13, 14] * 2 + [10, 11])


def test_candidates_come_from_all_evaluations() -> None:
    before, polished = evaluation([(99, True)]), evaluation([(49, True)])
    failed = evaluation([(9, False)])
    for several in ([before, polished], [polished, before], [polished, failed]):
        witness = best_of(several, Source.SEARCH, CONFIG)
        assert witness is not None
        assert witness.steps == 50


def test_candidates_are_all_successes_shortest_first() -> None:
    one, two = evaluation([(99, True)], [(9, True), (29, False)], [(30, True)]), evaluation([(30, True)], [(20, True)])
    steps = lambda candidates: [(witness.steps, witness.source) for witness in candidates]
    sampled, probable = Source.SAMPLED, Source.MOST_PROBABLE
    candidates = candidates_of([one, two], Source.SEARCH, CONFIG)
    assert steps(candidates) == [(21, sampled), (31, sampled), (31, probable), (100, probable)]
    assert steps(candidates_of([one, two], Source.SEARCH, replace(CONFIG, replays=0))) == [
        (31, probable),
        (100, probable),
    ]
    for witness in candidates:
        assert witness.action.shape == (RECORD_STEPS, 6)


def test_candidates_are_the_shortest_without_copies() -> None:
    config = replace(CONFIG, witness=Choice.SHORTEST)
    ends = [(end, True) for end in np.cumsum(np.arange(20, 8, -1)).tolist()]
    one = evaluation(ends)
    candidates = candidates_of([one, one, one], Source.SEARCH, config)
    assert [witness.steps for witness in candidates] == [n for n in [*range(9, 20), 21] for _ in "123"]
    whole = [[(end, True)] for end in range(40, 10, -1)]
    many = replace(CONFIG, environments=len(whole), attempts=len(whole), sticky_attempts=0, perturbed_attempts=0)
    shortest = candidates_of([evaluation(*whole, config=many)], Source.SEARCH, many)
    assert [witness.steps for witness in shortest] == list(range(12, 12 + MAX_CANDIDATES))
    assert len(candidates_of([one], Source.SEARCH, replace(config, replays=0))) == 1
    copies = evaluation(*[[(9, True), (19, True), (29, True)]] * 3)
    copies.action[:] = 1
    assert [witness.steps for witness in candidates_of([copies], Source.SEARCH, config)] == [10]


def test_rehearsed_success_is_a_candidate_only_if_allowed_and_without_others() -> None:
    failed, solved = evaluation([(9, False)], success=4), evaluation([(9, True)], success=4)
    assert best_of([failed], Source.SEARCH, replace(CONFIG, exploration=False)) is None
    assert best_of([evaluation([(9, False)])], Source.SEARCH, CONFIG) is None
    rehearsed, own = best_of([failed], Source.SEARCH, CONFIG), best_of([solved], Source.SEARCH, CONFIG)
    assert rehearsed is not None
    assert own is not None
    assert (rehearsed.source, rehearsed.steps) == (Source.SEARCH, 4)
    assert own.source is Source.MOST_PROBABLE
    assert [witness.source for witness in candidates_of([solved], Source.SEARCH, CONFIG)] == [own.source]


def test_shares_count_first_episodes_of_each_kind_of_attempt() -> None:
    """Attempts 0 to 2, two sticky, two perturbed, one spare; an unfinished first episode is a failure."""
    one = evaluation(
        [(9, False)],
        [(9, True), (19, True), (29, True)],
        [],
        [(9, True), (19, False)],
        [(9, False), (19, True)],
        [],
        [(3, True)],
        [(3, True)],
    )
    rate, sticky, perturbed = shares(one, CONFIG)
    assert (rate, sticky, perturbed) == (0.5, 0.5, 0.5)
    nothing = shares(evaluation(), replace(CONFIG, sticky_attempts=0, perturbed_attempts=0))
    assert nothing[0] == 0
    assert np.isnan(nothing[1:]).all()


def test_successful_episodes_returns_their_ranges() -> None:
    done, goal = np.zeros((2, RECORD_STEPS), bool)
    done[[3, 10, 255]], goal[[3, 255]] = True, True
    assert successful_episodes(done, goal) == [(0, 4), (11, 256)]
    assert successful_episodes(done & False, goal & False) == []


def test_repeated_fills_the_record() -> None:
    action = np.arange(18).reshape(3, 6)
    filled = repeated(action, 3)
    assert filled.shape == (RECORD_STEPS, 6)
    np.testing.assert_array_equal(filled[255], action[0])
