"""Portability: survival equals replays from perturbed starts, and decides the choice."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.verdict import portability
from levelproof.experts.verdict.judge import Witness, repeating
from levelproof.experts.verdict.portability import LATE, choose, moved, survival
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import repeat, take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.random_play import random_successes, searched_randomly

pytestmark = pytest.mark.slow

REPLAYS = 8
ROBUST, FRAGILE = 0, 2  # indices: random play of the first survives everything, of the other almost nothing
IDS = np.array([3, 2, 107, 100, 9, 1], np.int32)  # of size s; the last is trivial
FOUND = 5


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def witnesses(levels: Level) -> list[Witness]:
    """Return successes of random play in all but the last level."""
    at = np.arange(FOUND)
    success = random_successes(take(levels, at), IDS[at])
    each = zip(success.action, success.length, strict=True)
    return [witness for pair in each for witness in repeating(Success(*pair), Source.SEARCH)]


@pytest.fixture(scope="module")
def shares(levels: Level, witnesses: list[Witness]) -> np.ndarray:
    return survival(take(levels, np.arange(FOUND)), IDS[:FOUND], witnesses, REPLAYS, DEFAULT_RULES)


@pytest.fixture(scope="module")
def starts(levels: Level) -> Level:
    """Return perturbed starts of the first levels."""
    at = np.arange(FOUND)
    lanes = repeat(take(levels, at), REPLAYS)
    return jax.device_get(replace(lanes, state=jax.jit(moved, static_argnums=2)(lanes, IDS[at], REPLAYS)))


def test_portability_is_the_share_of_replays_that_reach_the_goal(
    starts: Level, witnesses: list[Witness], shares: np.ndarray
) -> None:
    action = np.repeat(np.stack([witness.action for witness in witnesses], -1), REPLAYS, -1)
    record = replay(starts, action)
    end = record.done.argmax(0)
    last = np.repeat([witness.steps + LATE for witness in witnesses], REPLAYS)
    reached = record.goal[end, np.arange(len(end))] & (end < last)
    np.testing.assert_array_equal(shares, reached.reshape(-1, REPLAYS).mean(-1))
    assert shares[ROBUST] == 1
    assert shares[FRAGILE] < 0.5


def test_moved_perturbs_starts_by_one_unit_in_the_last_place(levels: Level, starts: Level) -> None:
    before, after = repeat(take(levels, np.arange(FOUND)), REPLAYS), starts
    model = before.model
    movable = np.asarray(model.active & ((model.inverse_mass > 0) | (model.inverse_inertia > 0)))
    for name in ("position", "rotation", "velocity", "angular_velocity"):
        x, y = (np.moveaxis(np.asarray(getattr(level.state, name)), 0, -2) for level in (before, after))
        near = [x, np.nextafter(x, np.float32(np.inf)), np.nextafter(x, np.float32(-np.inf))]
        assert np.any([y == a for a in near], 0).all()
        if name != "rotation":  # many angles are 0, whose next float is subnormal and flushed to 0
            assert [np.any((y == a) & (x != 0) & movable) for a in near] == [x.any()] * 3
        np.testing.assert_array_equal(y[..., ~movable], x[..., ~movable])
    untouched = replace(after, state=replace(after.state, **{
        name: getattr(before.state, name) for name in ("position", "rotation", "velocity", "angular_velocity")
    }))  # fmt: skip
    jax.tree.map(np.testing.assert_array_equal, untouched, before)


@pytest.mark.parametrize("at", [[2], [4, 3, 2, 2, 1, 0]])
def test_portability_depends_on_the_level_alone(
    levels: Level, witnesses: list[Witness], shares: np.ndarray, at: list[int]
) -> None:
    """All candidates of a level are replayed from the same starts, whatever their neighbours."""
    some = survival(take(levels, np.array(at)), IDS[at], [witnesses[i] for i in at], REPLAYS, DEFAULT_RULES)
    np.testing.assert_array_equal(some, shares[at])


@pytest.mark.parametrize(("count", "blocks"), [(2, [16]), (17, [64]), (130, [128, 128])])
def test_survival_pads_few_candidates_to_a_small_block_on_accelerators(
    monkeypatch: pytest.MonkeyPatch, count: int, blocks: list[int]
) -> None:
    block_sizes = []

    def replayed(levels, level_ids, action, steps, replays, rules):
        block_sizes.append(len(level_ids))
        return level_ids.astype(np.float32)

    monkeypatch.setattr(portability, "survival_block", replayed)
    monkeypatch.setattr(portability, "at_once", lambda lanes, in_cache: 128)
    witness = Witness(np.zeros((256, 6), int), Source.SAMPLED, 1)
    survived = survival(np.zeros((1, count)), np.arange(count), [witness] * count, REPLAYS, DEFAULT_RULES)  # pyright: ignore[reportArgumentType]
    assert (survived.tolist(), block_sizes) == ([*range(count)], blocks)


def test_choose_takes_the_most_portable_candidate_first_of_equals(monkeypatch: pytest.MonkeyPatch) -> None:
    """`steps` identifies a candidate here and sets its portability."""
    replayed = []

    def known(levels, level_ids, now, replays, rules):
        replayed.extend((int(i), witness.steps) for i, witness in zip(level_ids, now, strict=True))
        return np.array([{1: 0.25, 2: 0.5, 3: 0.5, 4: 1.0, 5: 0.0}[witness.steps] for witness in now], np.float32)

    monkeypatch.setattr(portability, "survival", known)
    candidates = [
        [Witness(np.zeros(0), Source.SAMPLED, steps) for steps in names]
        for names in ([1, 2, 3], [], [4, 5], [5], [1, 4, 2])
    ]
    levels, ids = np.zeros((1, 5)), np.arange(5)
    chosen = choose(levels, ids, candidates, REPLAYS, DEFAULT_RULES)  # pyright: ignore[reportArgumentType]
    results = [(witness.steps, witness.portability) if witness else None for witness in chosen]
    assert results == [(2, 0.5), None, (4, 1.0), (5, 0.0), (4, 1.0)]
    assert (2, 5) not in replayed
    assert (4, 2) not in replayed, "the one before survived all"
    replayed.clear()
    known_one = candidates[0][0]._replace(portability=0.75)
    some = [[known_one, *candidates[0][1:]]]
    (again,) = choose(levels[:, :1], ids[:1], some, REPLAYS, DEFAULT_RULES)  # pyright: ignore[reportArgumentType]
    assert (again, replayed) == (known_one, [(0, 2), (0, 3)]), "known portability is not measured again"
    first = choose(levels, ids, candidates, 0, DEFAULT_RULES)  # pyright: ignore[reportArgumentType]
    assert [(witness.steps, witness.portability) if witness else None for witness in first] == [
        (1, None), None, (4, None), (5, None), (1, None),
    ]  # fmt: skip


def test_choose_prefers_the_portable_of_two_candidates(levels: Level, witnesses: list[Witness]) -> None:
    """The portable candidate comes after one that never reaches the goal, as if it had been luck on this machine."""
    good = witnesses[ROBUST]
    lucky = good._replace(action=np.zeros_like(good.action), steps=good.steps - 1)
    (chosen,) = choose(take(levels, np.array([ROBUST])), IDS[[ROBUST]], [[lucky, good]], REPLAYS, DEFAULT_RULES)
    assert chosen == good._replace(portability=1.0)


def labelled(monkeypatch: pytest.MonkeyPatch, levels: Level, replays: int) -> UnitResult:
    procedure = Procedure(
        SearchConfig(env_steps=0, robustness=0), ExpertConfig(replays=replays), StopConfig(rule=Rule.NONE)
    )
    searched_randomly(monkeypatch)
    return label(levels, IDS, 4096, procedure)


def test_verdict_has_portability_if_it_has_a_witness(
    monkeypatch: pytest.MonkeyPatch, levels: Level, shares: np.ndarray
) -> None:
    verdicts = labelled(monkeypatch, levels, REPLAYS).verdicts
    assert [verdict.portability for verdict in verdicts[:FOUND]] == shares.tolist()
    assert verdicts[FOUND].label is Label.TRIVIAL
    assert verdicts[FOUND].portability is not None
    assert {verdict.portability for verdict in labelled(monkeypatch, levels, 0).verdicts} == {None}
