"""Continuous batching on real levels: when levels leave, and that results do not depend on it."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.alone import label
from benchmarks.endless import endless_slots
from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.pool.found import nothing_found
from levelproof.experts.pool.pool import Pool, TrainingJob
from levelproof.experts.training import advance as advance_module
from levelproof.experts.training.advance import advance
from levelproof.experts.training.progress import NEVER
from levelproof.experts.training.slots import Mode
from levelproof.experts.training.stop import rules_of
from levelproof.experts.verdict.judge import TrainedLevel
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.random_play import random_successes
from tests.experts.small import CONFIG, IDS, SHAPED, WHOLE, untouched

pytestmark = pytest.mark.slow

SOLVED = StopConfig(rule=Rule.SOLVED, successes=2, share=0.6, wait=2048)
HALVED = StopConfig(rule=Rule.HALVING, successes=4, first_rung=4 * 512, gain=10.0)
UPDATES = 24  # 12,288 env steps


def train(
    levels: Level, level_ids: np.ndarray, updates: int, config: ExpertConfig, stopping: StopConfig, **how: Any
) -> tuple[list[TrainedLevel], TrainingJob]:
    pool = Pool(updates * config.steps_per_update, untouched(stopping, config), DEFAULT_RULES)
    submission = pool.submit(levels, level_ids, **how)
    while not pool.step():
        pass
    return submission.trained(config), submission


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def solved(levels: Level) -> list[TrainedLevel]:
    return train(levels, IDS, UPDATES, CONFIG, SOLVED)[0]


@pytest.fixture(scope="module")
def whole(levels: Level) -> list[TrainedLevel]:
    return train(levels, IDS, UPDATES, CONFIG, WHOLE, keep=True)[0]


def same(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_solved_levels_leave_their_slots(solved: list[TrainedLevel], whole: list[TrainedLevel]) -> None:
    steps = [len(level.curve) for level in solved]
    assert min(steps) < UPDATES, "one of these levels should be solved early"
    assert max(steps) == UPDATES, "one of these levels should not be solved"
    assert [len(level.curve) for level in whole] == [UPDATES] * len(IDS)
    for level in solved:
        assert int(level.evaluations[-1].progress.env_steps) == len(level.curve) * CONFIG.steps_per_update


def test_evaluation_leaves_no_trace_in_training(solved: list[TrainedLevel], whole: list[TrainedLevel]) -> None:
    for early, late in zip(solved, whole, strict=True):
        np.testing.assert_array_equal(early.curve, late.curve[: len(early.curve)])


@pytest.mark.parametrize("at", [[5, 1, 3], [6], [2, 6, 5, 4, 0]])
def test_result_depends_neither_on_slot_nor_on_neighbours(
    levels: Level, solved: list[TrainedLevel], at: list[int]
) -> None:
    some, _ = train(take(levels, np.array(at)), IDS[at], UPDATES, CONFIG, SOLVED)
    for i, level in zip(at, some, strict=True):
        same(level, solved[i])


def test_level_trains_then_is_evaluated_then_leaves(levels: Level) -> None:
    slots, modes, left = endless_slots(take(levels, np.arange(2)), IDS[:2], CONFIG, updates=2), [], []
    for _ in range(2 + CONFIG.record_rollouts + 1):
        slots, report = advance(slots, CONFIG, rules_of(WHOLE, CONFIG), SHAPED)
        modes.append(report.mode)
        left.append(report.left)
    path = [Mode.TRAIN] * 2 + [Mode.EVALUATE] * CONFIG.record_rollouts + [Mode.EMPTY]
    np.testing.assert_array_equal(modes, np.transpose([path] * 2))
    np.testing.assert_array_equal(np.sum(left, axis=0), 1)
    assert left[-2].all()


def test_advance_is_compiled_once(levels: Level) -> None:
    """Other numbers of levels, budgets and rules share the program."""
    train(take(levels, np.arange(3)), IDS[:3], 2, CONFIG, SOLVED)
    before = advance.count()
    for stopping in (SOLVED, WHOLE, HALVED):
        train(levels, IDS, 3, CONFIG, stopping)
    assert advance.count() == before


def test_hopeless_levels_leave_at_a_rung(levels: Level, whole: list[TrainedLevel]) -> None:
    halved, submission = train(levels, IDS, UPDATES, CONFIG, HALVED)
    never = [i for i, level in enumerate(whole) if int(level.evaluations[-1].progress.first_success) < 0]
    assert never
    for i in never:
        assert len(halved[i].curve) in (4, 8)  # at the first rung there is nothing to compare with
    assert submission.trained_rollouts == sum(len(level.curve) for level in halved)
    verdicts = label(levels, IDS, UPDATES * 512, untouched(HALVED)).verdicts
    reasons = {i: verdict.label_reason for i, verdict in enumerate(verdicts) if verdict.label is Label.UNSOLVED}
    assert all("at a rung the best return had not grown" in reasons[i] for i in never)


def test_fruitless_expert_reports_why_it_left(levels: Level, whole: list[TrainedLevel]) -> None:
    never = [i for i, level in enumerate(whole) if int(level.evaluations[-1].progress.first_success) < 0]
    stopping = replace(HALVED, first_rung=UPDATES * 512, fruitless=5 * 512)
    verdicts = label(levels, IDS, UPDATES * 512, untouched(stopping)).verdicts
    assert never
    for i in never:
        assert verdicts[i].env_steps == 5 * 512
        if verdicts[i].label is Label.UNSOLVED:
            assert verdicts[i].label_reason.startswith(
                "the expert never reached the goal in training, so it left after 2560 env steps; none of the 4 attempts"
            )
    assert Label.UNSOLVED in {verdicts[i].label for i in never}


def test_success_of_training_is_the_witness_if_no_evaluation_succeeds(levels: Level) -> None:
    """Which level qualifies depends on the machine's rounding, so several budgets are tried."""
    sources = set()
    for updates in (2, 3, 4, 6, 8, 12):
        for verdict in label(levels, IDS, updates * 512, untouched(replace(WHOLE, successes=4))).verdicts:
            sources.add(verdict.witness)
            if verdict.steps_to_first_success is not None:
                assert verdict.label is Label.SOLVED
            if verdict.witness is Source.EXPLORATION:
                assert not verdict.most_probable_succeeds
    assert Source.EXPLORATION in sources


@pytest.mark.campaign
def test_polish_continues_training_after_a_level_is_solved(levels: Level, solved: list[TrainedLevel]) -> None:
    polished, _ = train(levels, IDS, UPDATES, CONFIG, replace(SOLVED, polish=4 * 512))
    early = [i for i, level in enumerate(solved) if len(level.curve) < UPDATES - 4]
    assert early
    for i in early:
        assert len(polished[i].curve) == len(solved[i].curve) + 4
        assert len(polished[i].evaluations) == 2
        same(polished[i].evaluations[0], solved[i].evaluations[0])


@pytest.mark.parametrize("stopping", [WHOLE, SOLVED, HALVED], ids=["budget", "solved", "halving"])
def test_continued_expert_equals_one_trained_without_a_break(levels: Level, stopping: StopConfig) -> None:
    """A level that left at a rung is over, and uses none of the larger budget."""
    through, _ = train(levels, IDS, UPDATES, CONFIG, stopping, keep=True)
    first, _ = train(levels, IDS, UPDATES // 2, CONFIG, stopping, keep=True)
    left = [i for i, level in enumerate(first) if stopping == WHOLE or not level.candidates]
    assert (stopping == HALVED) == any(len(first[i].curve) < UPDATES // 2 for i in left)
    begun = {number: first[i].expert for number, i in enumerate(left)}
    later, submission = train(
        take(levels, np.array(left)), IDS[left], UPDATES, CONFIG, stopping, begun=begun, keep=True
    )  # type: ignore[arg-type]
    assert submission.trained_rollouts == sum(len(through[i].curve) - len(first[i].curve) for i in left)
    for i, level in zip(left, later, strict=True):
        same(level, through[i])


def test_expert_keeps_an_earlier_success(levels: Level, whole: list[TrainedLevel]) -> None:
    """Training keeps the search's success; levels without one train as they do without a search."""
    findings = nothing_found(len(IDS))._replace(success=random_successes(levels, IDS))
    trained, _ = train(levels, IDS, 2, CONFIG, WHOLE, found=findings)
    assert 0 < (findings.success.length > 0).sum() < len(IDS)
    for i, level in enumerate(trained):
        assert (
            np.array_equal(level.evaluations[-1].success.action, findings.success.action[i])
            or not findings.success.length[i]
        )
        if not findings.success.length[i]:
            same(level.curve, whole[i].curve[:2])


def test_success_of_a_sticky_lane_is_not_the_experts_own() -> None:
    """A sticky lane mostly ignores the expert's samples, as a rehearsing lane does."""
    ids = np.arange(100, 164)
    trained, _ = train(jax.tree.map(np.asarray, sample_levels(ids, SIZES["s"])), ids, 1, CONFIG, WHOLE)
    last = [(level.evaluations[-1], level.curve[0]) for level in trained]
    forced = [share for shown, share in last if shown.success.length and shown.progress.first_success == NEVER]
    assert forced, "in some of these levels no other lane reaches the goal"
    assert all(np.isnan(share) or share == 0 for share in forced)


def test_diverged_expert_leaves_and_reports_why(levels: Level, whole: list[TrainedLevel]) -> None:
    begun = {}
    for i, weight in enumerate((np.inf, np.nan)):
        kept = whole[i].expert
        assert kept
        training = kept.begun.training
        params = jax.tree.map(lambda x, weight=weight: np.full_like(x, weight), training.train_state.params)
        # what it finds by chance would be a witness: it takes doing nothing for its success
        success = Success(np.zeros_like(training.success.action), np.ones_like(training.success.length))
        training = training._replace(train_state=training.train_state._replace(params=params), success=success)
        begun[int(IDS[i])] = kept._replace(begun=kept.begun._replace(training=training))
    some, budget = take(levels, np.arange(2)), 2 * UPDATES * 512
    for verdict in label(some, IDS[:2], budget, untouched(WHOLE), begun=begun).verdicts:
        assert verdict.label is Label.UNSOLVED
        assert verdict.env_steps == (UPDATES + 1) * 512
        assert f"its network's numbers stopped being finite after {verdict.env_steps} env steps" in verdict.label_reason


@pytest.mark.campaign
def test_vmapped_slots_of_accelerators_give_the_same_results(levels: Level, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decisions are equal, numbers nearly so, because sums are taken in another order."""

    def go(advance) -> list:
        slots, reports = endless_slots(take(levels, np.arange(2)), IDS[:2], CONFIG, updates=3), []
        for _ in range(3 + CONFIG.record_rollouts):
            slots, report = advance(slots, CONFIG, rules_of(WHOLE, CONFIG), SHAPED)
            reports.append(report)
        return [jax.device_get(reports), jax.device_get(slots.slot.training)]

    one_by_one, ours = go(advance)
    monkeypatch.setattr(advance_module, "over_slots", lambda function, *slots: jax.vmap(function)(*slots))
    together, theirs = go(jax.jit(advance.__wrapped__, static_argnums=(1, 3)))
    same([(r.mode, r.left) for r in one_by_one], [(r.mode, r.left) for r in together])
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), ours.train_state.params, theirs.train_state.params
    )
