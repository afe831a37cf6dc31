"""Rework makes fragile witnesses robust, whatever their neighbours, and counts its env steps."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Source
from levelproof.experts.pool.rework import rework
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.verdict.judge import Witness, repeating
from levelproof.experts.verdict.portability import survival
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import replay, steps_to_goal
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.random_play import random_successes, searched_randomly

pytestmark = pytest.mark.slow

IDS = np.array([3, 1522], np.int32)  # of size s: random play of the second survives few replays
STEADY, FRAGILE = 0, 1
PROCEDURE = Procedure(SearchConfig(env_steps=0), ExpertConfig(), StopConfig(rule=Rule.NONE))


@cache
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@cache
def witnesses() -> list[Witness]:
    pairs = zip(*random_successes(levels(), IDS), strict=True)
    successes = [witness for pair in pairs for witness in repeating(Success(*pair), Source.EXPLORATION)]
    shares = survival(levels(), IDS, successes, 32, DEFAULT_RULES).tolist()
    return [witness._replace(portability=share) for witness, share in zip(successes, shares, strict=True)]


def test_rework_changes_only_fragile_witnesses(monkeypatch: pytest.MonkeyPatch) -> None:
    (same, better), env_steps = rework(levels(), IDS, witnesses(), PROCEDURE, DEFAULT_RULES)
    before = witnesses()[FRAGILE]
    assert same is witnesses()[STEADY]
    assert env_steps[STEADY] == 0 < env_steps[FRAGILE]
    assert better is not None
    assert before.portability is not None
    assert before.portability < 0.5 < (better.portability or 0)
    assert better.source is Source.SEARCH
    record = replay(take(levels(), np.array([FRAGILE])), better.action[..., None])
    assert steps_to_goal(record.done) == better.steps
    assert record.goal[record.done].all()

    mirrored = take(levels(), np.array([1, 0]))
    (again, _), steps = rework(mirrored, IDS[::-1], witnesses()[::-1], PROCEDURE, DEFAULT_RULES)
    assert again is not None
    np.testing.assert_array_equal(again.action, better.action)
    assert (again.steps, again.portability, steps[0]) == (better.steps, better.portability, env_steps[FRAGILE])

    searched_randomly(monkeypatch)
    result = label(levels(), IDS, 4096, PROCEDURE)
    verdicts = result.verdicts
    assert [verdict.search_steps for verdict in verdicts] == env_steps.tolist()
    assert result.spent.searched == env_steps.sum()
    assert (verdicts[FRAGILE].witness, verdicts[FRAGILE].portability) == (Source.SEARCH, better.portability)
    assert verdicts[FRAGILE].cells is None, "no search ran before"


def test_rework_keeps_an_experts_own_witness_unless_most_replays_fail() -> None:
    """The same actions are varied, whatever their source."""
    fragile, own = witnesses()[FRAGILE], Source.SAMPLED
    assert fragile.portability is not None
    for source, share, stays in ((own, 0.5, True), (own, 0.45, False), (Source.EXPLORATION, 0.5, False)):
        before = fragile._replace(source=source, portability=share)
        some = take(levels(), np.array([FRAGILE]))
        (after,), _ = rework(some, IDS[[FRAGILE]], [before], PROCEDURE, DEFAULT_RULES)
        assert after is not None
        assert (after is before) == stays
        assert after.source is (own if stays else Source.SEARCH)


def test_rework_without_rounds_or_replays_changes_nothing() -> None:
    for procedure in (
        replace(PROCEDURE, search=replace(PROCEDURE.search, robustness=0)),
        replace(PROCEDURE, expert=replace(PROCEDURE.expert, replays=0)),
    ):
        reworked, env_steps = rework(levels(), IDS, witnesses(), procedure, DEFAULT_RULES)
        assert all(a is b for a, b in zip(reworked, witnesses(), strict=True))
        assert not env_steps.any()
