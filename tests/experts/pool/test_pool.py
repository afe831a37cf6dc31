"""Submissions that share a pool: each gets the results that it would get alone, whenever it arrives."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.experts.pool.found import nothing_found
from levelproof.experts.pool.paused import Paused
from levelproof.experts.pool.pool import GROUP, Pool, TrainingJob
from levelproof.experts.pool.run import spent_on
from levelproof.experts.steps import EnvSteps
from levelproof.experts.training.slots import Pending, begin
from levelproof.experts.verdict.judge import KeptExpert, TrainedLevel, Witness
from levelproof.experts.verdict.portability import PORTABLE, choose
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.small import CONFIG, WHOLE, untouched
from tests.experts.training.test_slots import SOLVED, same

pytestmark = pytest.mark.slow

IDS = np.arange(100, 136)
UPDATES = 6


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def alone(levels: Level) -> list[TrainedLevel]:
    pool = new_pool()
    (submission,) = finished(pool, pool.submit(levels, IDS))
    return submission.trained(CONFIG)


def new_pool() -> Pool:
    return Pool(UPDATES * CONFIG.steps_per_update, untouched(SOLVED), DEFAULT_RULES)


def part(levels: Level, at: range) -> tuple[Level, np.ndarray]:
    return take(levels, np.array(at, int)), IDS[np.array(at, int)]


def finished(pool: Pool, *submissions: TrainingJob) -> list[TrainingJob]:
    """Step the pool until these submissions have finished; return all in the order in which they finish."""
    done: list[TrainingJob] = []
    while not set(submissions) <= set(done):
        done += pool.step()
    return done


def test_submissions_give_the_results_that_each_gives_alone(levels: Level, alone: list[TrainedLevel]) -> None:
    pool, parts = new_pool(), [range(20), range(20, 23), range(23, 36), range(0)]
    submissions = [pool.submit(*part(levels, at)) for at in parts]
    order = finished(pool, *submissions)
    assert order[0] is submissions[3]  # without levels
    assert len(order) == len(parts)
    trained = [level for submission in submissions for level in submission.trained(CONFIG)]
    assert len(trained) == len(IDS)
    same(trained, alone)
    for submission in submissions:
        curves = sum(len(level.curve) for level in submission.trained(CONFIG))
        assert submission.trained_rollouts == curves


def test_an_expert_that_has_used_the_budgets_updates_trains_no_further(levels: Level) -> None:
    """A larger budget may have room for no further update."""
    some, ids = part(levels, range(12))
    pool = new_pool()
    (first,) = finished(pool, pool.submit(some, ids, keep=True))
    before = first.trained(CONFIG)
    spent = [i for i, one in enumerate(before) if len(one.curve) == UPDATES and not one.candidates]
    begun = {row: expert for row, i in enumerate(spent) if (expert := before[i].expert)}
    assert len(begun) == len(spent) > 0
    pool = new_pool()
    (second,) = finished(pool, pool.submit(take(some, np.array(spent)), ids[spent], begun=begun))
    assert second.trained_rollouts == 0
    for i, after in zip(spent, second.trained(CONFIG), strict=True):
        assert after.curve == before[i].curve
        assert not after.candidates


def test_later_levels_enter_empty_slots(levels: Level) -> None:
    """One level occupies one slot; later levels enter the other."""
    pool = new_pool()
    first = pool.submit(*part(levels, range(1)))
    assert pool.step() == []
    second = pool.submit(*part(levels, range(1, 4)))
    finished(pool, first, second)
    assert first.idle_rollouts == 1  # of the first rollout alone


def test_withdraw_removes_waiting_levels_and_changes_no_other(levels: Level, alone: list[TrainedLevel]) -> None:
    """Another pool gives them the same results."""
    pool, other = new_pool(), new_pool()
    first, second = pool.submit(*part(levels, range(30))), pool.submit(*part(levels, range(30, 36)))
    for _ in range(3):
        pool.step()
    assert pool.waiting(first)[-1] == 29
    assert pool.waiting(second) == list(range(6))
    gone = pool.waiting(first)[3:]
    pool.withdraw(first, gone)
    assert not set(gone) & set(pool.waiting(first))
    later = other.submit(take(levels, np.array(gone)), IDS[gone])
    finished(pool, first, second)
    finished(other, later)
    trained = dict(zip(gone, later.trained(CONFIG), strict=True))
    trained = dict(enumerate(first.trained(CONFIG))) | trained | dict(enumerate(second.trained(CONFIG), 30))
    same([trained[i] for i in range(36)], alone)


def test_paused_expert_resumes_to_the_same_result(levels: Level, alone: list[TrainedLevel]) -> None:
    """It resumes in another pool's slot, after a training step or amid an evaluation."""
    pool, evaluated = new_pool(), 0
    submission = pool.submit(*part(levels, range(4)))
    while True:
        now = {i: level for _, i, level in pool.paused()}
        evaluated += sum(bool(level.pending.due or level.pending.final) for level in now.values())
        if evaluated > 1:
            break
        pool.step()
    steps = sum(len(level.expert.curve) for level in now.values())
    assert steps, "one has begun"
    other, at = new_pool(), np.array(sorted(now))
    paused = {row: now[i] for row, i in enumerate(at)}
    later = other.submit(take(levels, at), IDS[at], paused=paused)
    finished(other, later)
    same(later.trained(CONFIG), [alone[i] for i in at])
    assert later.trained_rollouts == sum(len(alone[i].curve) for i in at) - steps
    finished(pool, submission)
    same(submission.trained(CONFIG), alone[:4])


@pytest.fixture
def never_portable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make no witness portable."""
    monkeypatch.setattr("levelproof.experts.pool.pool.PORTABLE", 2)


def steadied(updates: int) -> Pool:
    """Return a pool in which solved levels train on for `updates` updates, at most 10 in all."""
    stopping = replace(SOLVED, robustness=updates * CONFIG.steps_per_update)
    return Pool(10 * CONFIG.steps_per_update, untouched(stopping), DEFAULT_RULES)


def trained_by(pool: Pool, levels: Level) -> list[TrainedLevel]:
    (submission,) = finished(pool, pool.submit(levels, IDS))
    return submission.trained(CONFIG)


def chosen(levels: Level, i: int, trained: TrainedLevel) -> Witness:
    """Return a level's witness."""
    level, candidates = take(levels, np.array([i])), [trained.candidates]
    (witness,) = choose(level, IDS[[i]], candidates, CONFIG.replays, DEFAULT_RULES)
    assert witness is not None
    assert witness.portability is not None
    return witness


def test_only_levels_with_fragile_witnesses_train_on(levels: Level) -> None:
    at_once, waited = (trained_by(steadied(updates), levels) for updates in (0, 3))
    left = [i for i, level in enumerate(at_once) if len(level.curve) < 10]
    assert left
    for i in left:
        before, best = len(at_once[i].curve), chosen(levels, i, at_once[i])
        stays = (best.portability or 0) < PORTABLE
        assert len(waited[i].curve) > before if stays else len(waited[i].curve) == before
        assert stays or [witness.steps for witness in waited[i].candidates] == [best.steps]


@pytest.mark.usefixtures("never_portable")
def test_stop_robustness_limits_further_training(levels: Level) -> None:
    """The learning curve extends the earlier one, and the best witness of all evaluations is kept."""
    at_once, waited = (trained_by(steadied(updates), levels) for updates in (0, 3))
    early = [i for i, level in enumerate(at_once) if level.candidates and len(level.curve) < 10]
    assert early
    for i in early:
        before, after = at_once[i], waited[i]
        assert len(after.curve) == min(len(before.curve) + 3, 10)
        np.testing.assert_array_equal(after.curve[: len(before.curve)], before.curve)
        same(after.evaluations[0], before.evaluations[0])
        best, now = chosen(levels, i, before), chosen(levels, i, after)
        assert (now.portability or 0, -now.steps) >= (best.portability or 0, -best.steps)


@pytest.mark.usefixtures("never_portable")
def test_further_training_is_independent_of_neighbours_and_pauses(levels: Level) -> None:
    alone = trained_by(steadied(3), levels)
    assert any(len(level.evaluations) > 1 for level in alone)
    pool = steadied(3)
    parts = [pool.submit(*part(levels, at)) for at in (range(7), range(7, 36))]
    finished(pool, *parts)
    same([level for submission in parts for level in submission.trained(CONFIG)], alone)

    stopped = steadied(3)
    submission = stopped.submit(levels, IDS)
    paused: dict[int, Paused] = {}
    while not stopped.step():
        for _, i, now in stopped.paused():
            if now.evaluations and i not in paused:  # the level has been solved once
                paused[i] = now
    same(submission.trained(CONFIG), alone)
    assert paused
    at, other = np.array(sorted(paused)), steadied(3)
    later = other.submit(take(levels, at), IDS[at], paused={row: paused[i] for row, i in enumerate(at.tolist())})
    finished(other, later)
    outcomes = lambda trained, at: [
        level._replace(candidates=[chosen(levels, i, level)]) for i, level in zip(at, trained, strict=True)
    ]
    same(outcomes(later.trained(CONFIG), at), outcomes([alone[i] for i in at], at))


def test_totals_grow_to_the_whole(levels: Level) -> None:
    pool = new_pool()
    submission, totals = pool.submit(*part(levels, range(5))), []
    while not pool.step():
        totals.append(pool.totals(submission))
    totals.append(pool.totals(submission))
    for numbers in zip(*totals, strict=True):
        assert list(numbers) == sorted(numbers)
    assert totals[-1][:2] == (submission.trained_rollouts * CONFIG.steps_per_update, 5)


def test_pool_wants_levels_while_fewer_wait_than_slots(levels: Level) -> None:
    pool = new_pool()
    assert [pool.wants(searched) for searched in (0, 1, 5)] == [2, 1, 0]
    pool.submit(*part(levels, range(5)))
    assert pool.wants(0) == 0
    wanted: list[int] = []
    while not pool.step():
        wanted.append(pool.wants(0))
    assert wanted[0] == 0  # three wait
    assert wanted == sorted(wanted)
    assert pool.wants(0) == 2


def test_slow_level_keeps_no_slot_empty(levels: Level) -> None:
    """The next level enters as soon as one leaves the other slot."""
    pool = Pool(400 * CONFIG.steps_per_update, untouched(WHOLE), DEFAULT_RULES)
    some, ids = part(levels, range(GROUP))  # as many as the pool's program begins
    experts = jax.device_get(begin(some, ids, no_success(GROUP), CONFIG))
    soon, no = np.int32(1), np.bool_(False)  # they leave after an update
    paused = {
        i: Paused(
            KeptExpert(jax.tree.map(lambda x, i=i: x[i], experts), []), Pending(no, no, soon), 0, [], nothing_found(1)
        )
        for i in range(1, GROUP)
    }
    submission = pool.submit(some, ids, paused=paused)
    while pool.waiting(submission):
        assert pool.step() == []
    assert 0 in submission.under_way
    assert submission.idle_rollouts == 0


def test_env_steps_of_earlier_processes_are_not_counted_again() -> None:
    verdicts: Any = [SimpleNamespace(search_steps=steps, evaluation_steps=2 * steps) for steps in (100, 5000)]
    job: Any = SimpleNamespace(trained_rollouts=3, idle_rollouts=1)
    earlier: Any = [SimpleNamespace(evaluated_rollouts=2, found=SimpleNamespace(search_steps=np.array([4000])))]
    each = CONFIG.steps_per_update
    assert spent_on(verdicts, job, CONFIG, earlier) == EnvSteps(1100, 3 * each, 10_200 - 2 * each, each)
