"""Experts on real levels: verdicts, witnesses, and independence of neighbours."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import RECORD_STEPS, ExpertConfig, StopConfig
from levelproof.experts.labels import Label
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.witness.witness import replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import LANES
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.small import CONFIG, IDS, WHOLE, untouched
from tests.experts.training.test_slots import same

UPDATES = 24
BUDGET = UPDATES * CONFIG.steps_per_update + 100


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(jnp.asarray(IDS), SIZES["s"], Distribution()))


@pytest.fixture(scope="module")
def reports() -> list[tuple[int, float, int]]:
    return []


@pytest.fixture(scope="module")
def result(levels: Level, reports) -> UnitResult:
    return label(levels, IDS, BUDGET, untouched(WHOLE), report=lambda *now: reports.append(now))


@pytest.mark.slow
def test_run_returns_consistent_verdicts(result: UnitResult) -> None:
    assert [int(i) for i in result.level_ids] == IDS.tolist()
    labels = {v.label for v in result.verdicts}
    assert labels == {Label.SOLVED, Label.UNSOLVED}, "these levels should show both"
    for verdict in result.verdicts:
        assert verdict.env_steps == UPDATES * 512 <= BUDGET
        assert len(verdict.learning_curve) == UPDATES
        assert np.isnan(verdict.success_rate) or 0 <= verdict.success_rate <= 1
        assert (verdict.steps_to_goal is not None) == (verdict.label is Label.SOLVED)
        if verdict.steps_to_first_success is not None:
            assert 0 < verdict.steps_to_first_success <= verdict.env_steps
        assert verdict.label_reason


def test_only_solved_levels_have_a_witness(levels: Level, result: UnitResult) -> None:
    record = result.record
    solved = np.array([v.label is Label.SOLVED for v in result.verdicts])
    np.testing.assert_array_equal(succeeds(record.done, record.goal), solved)
    first = [v.steps_to_goal for v in result.verdicts if v.steps_to_goal is not None]
    np.testing.assert_array_equal(steps_to_goal(record.done)[solved], first)
    again = replay(jax.tree.map(lambda x: x[..., solved], levels), np.asarray(record.action)[..., solved])
    same(again, jax.tree.map(lambda x: x[..., solved], record))
    assert not any(np.any(x[..., ~solved]) for x in jax.tree.leaves(record))


def test_result_depends_on_the_level_alone(levels: Level, result: UnitResult) -> None:
    at = [4, 1, 2]
    some = label(jax.tree.map(lambda x: x[..., at], levels), IDS[at], BUDGET, untouched(WHOLE))
    for i, verdict in zip(at, some.verdicts, strict=True):
        np.testing.assert_equal(vars(verdict), vars(result.verdicts[i]))
    same(some.record, jax.tree.map(lambda x: x[..., at], result.record))


@pytest.mark.campaign  # compiles all programs of training once more
def test_the_number_of_slots_changes_no_result(levels: Level, result: UnitResult) -> None:
    other = label(levels, IDS, BUDGET, untouched(WHOLE, replace(CONFIG, slots=3)))
    np.testing.assert_equal([vars(verdict) for verdict in other.verdicts], [vars(one) for one in result.verdicts])
    same(other.record, result.record)


def test_progress_is_reported(reports: list[tuple[int, float, int]], result: UnitResult) -> None:
    for totals in zip(*reports, strict=True):
        assert list(totals) == sorted(totals)
    solved = sum(v.label is Label.SOLVED for v in result.verdicts)
    assert reports[-1] == (len(IDS) * UPDATES * 512, len(IDS), solved)
    assert result.spent.trained == reports[-1][0]


def test_replay_gives_the_same_bits_at_every_count(levels: Level) -> None:
    rng = np.random.default_rng(0)
    count = LANES + 6  # two blocks
    many = jax.tree.map(lambda x: np.resize(np.moveaxis(x, -1, 0), (count, *x.shape[:-1])), levels)
    many = jax.tree.map(lambda x: np.moveaxis(x, 0, -1), many)
    action = rng.integers(0, 2, (RECORD_STEPS, 6, count))
    whole = replay(many, action)
    for at in ([0], [3, count - 1], list(range(5, 25))):
        same(
            replay(jax.tree.map(lambda x, at=at: x[..., at], many), action[..., at]),
            jax.tree.map(lambda x, at=at: x[..., at], whole),
        )


def test_record_resets_after_each_episode(levels: Level) -> None:
    action = np.random.default_rng(1).integers(0, 2, (RECORD_STEPS, 6, len(IDS)))
    record = replay(levels, action)
    for lane in range(len(IDS)):
        starts = np.concatenate([[0], np.flatnonzero(record.done[:-1, lane]) + 1])
        np.testing.assert_array_equal(np.flatnonzero(record.timestep[:, lane] == 0), starts)
        for t in starts:
            same(
                jax.tree.map(lambda x, t=t, lane=lane: x[t, ..., lane], record.state),
                jax.tree.map(lambda x, lane=lane: x[..., lane], levels.state),
            )
            assert not record.manifold.active[t, :, lane].any()
            assert record.last_distance[t, lane] == -1


def test_run_accepts_levels_that_need_no_expert() -> None:
    trivial = np.array([1])
    result = label(sample_levels(jnp.asarray(trivial), SIZES["s"], Distribution()), trivial, BUDGET, untouched(WHOLE))
    assert [v.label for v in result.verdicts] == [Label.TRIVIAL]
    assert (result.spent.trained, result.spent.idle) == (0, 0)


@pytest.mark.parametrize(
    ("budget", "stopping", "words"),
    [
        (511, StopConfig(), "budget is 511: one update of an expert takes 512 env steps"),
        (2**31, StopConfig(), "budget is 2147483648: the maximum is 2147483647 env steps"),
        (2**31 - 1, StopConfig(wait=2**35), "stop.wait is 34359738368: with a budget of 2147483647"),
        (1024, StopConfig(polish=2**41), "stop.polish is"),
        (1024, StopConfig(first_rung=2**41), "stop.first_rung is"),
    ],
)
def test_pool_rejects_a_budget_that_experts_cannot_use(budget: int, stopping: StopConfig, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Pool(budget, untouched(stopping), DEFAULT_RULES)


def test_pool_accepts_the_largest_budget() -> None:
    assert Pool(2**31 - 1, untouched(StopConfig(wait=2**24)), DEFAULT_RULES).updates == 2**22 - 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "width is 0"),
        ({"minibatches": 3}, "must divide"),
        ({"attempts": 64}, "add up to 80"),
        ({"rehearsals": 32}, "rehearsals is 32: it must be below environments = 32"),
        ({"persistence": 1.5}, "persistence is 1.5: it must be between 0 and 1"),
        ({"clip": 2.0}, "clip is 2.0"),
    ],
)
def test_expert_config_rejects_invalid_hyperparameters(change: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ExpertConfig(**change)
