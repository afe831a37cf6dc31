"""Levels that need no expert: their labels, the evidence, and that no expert trains on them."""

import jax
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.labels import Label, Verdict
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.before import decide, facts_of
from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.proofs import Proof
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES

COUNT = 150  # three blocks, the last one not full


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(np.arange(COUNT), SIZES["s"]))


@pytest.fixture(scope="module")
def verdicts(levels: Level) -> list[Verdict | None]:
    return decide(levels, DEFAULT_RULES).verdicts


def indices(verdicts: list[Verdict | None], label: Label) -> list[int]:
    return [i for i, verdict in enumerate(verdicts) if verdict and verdict.label is label]


def test_decide_labels_levels_trivial_if_doing_nothing_solves_them(
    levels: Level, verdicts: list[Verdict | None]
) -> None:
    idle = replay(levels, np.zeros((RECORD_STEPS, 6, COUNT), np.int32))
    trivial = indices(verdicts, Label.TRIVIAL)
    np.testing.assert_array_equal(trivial, np.flatnonzero(succeeds(idle.done, idle.goal)))
    assert len(trivial) > 10
    for i in trivial:
        verdict = verdicts[i]
        assert verdict
        assert verdict.steps_to_goal == np.argmax(idle.done[:, i]) + 1
        assert f"doing nothing reaches the goal in {verdict.steps_to_goal} env steps" == verdict.label_reason
        assert (verdict.env_steps, verdict.success_rate, verdict.failed_by_noop) == (0, 1.0, False)


def test_decide_labels_levels_unsolvable_only_with_a_proof(levels: Level, verdicts: list[Verdict | None]) -> None:
    known = facts_of(levels, DEFAULT_RULES)
    unsolvable = indices(verdicts, Label.UNSOLVABLE)
    np.testing.assert_array_equal(unsolvable, np.flatnonzero(known.proof != Proof.NONE))
    assert len(unsolvable) > 3
    for i in unsolvable:
        verdict = verdicts[i]
        assert verdict
        assert verdict.label_reason.startswith("no action has an effect, and doing nothing ")
        assert (verdict.env_steps, verdict.success_rate, verdict.steps_to_goal) == (0, 0.0, None)
        assert verdict.failed_by_noop == ("red" in verdict.label_reason)


def test_facts_do_not_depend_on_neighbours(levels: Level) -> None:
    known = facts_of(levels, DEFAULT_RULES)
    at = np.array([149, 3, 64, 70])
    for all_of, some in zip(known, facts_of(take(levels, at), DEFAULT_RULES), strict=True):
        np.testing.assert_array_equal(all_of[at], some)


def test_run_trains_no_expert_for_decided_levels(levels: Level, verdicts: list[Verdict | None]) -> None:
    """An expert of this configuration would need a terabyte."""
    trivial, unsolvable = indices(verdicts, Label.TRIVIAL)[:3], indices(verdicts, Label.UNSOLVABLE)[:2]
    at = np.array([*trivial, *unsolvable])
    result = label(take(levels, at), at, 10**9, Procedure(expert=ExpertConfig(width=10**6, depth=2)))
    assert [v.label for v in result.verdicts] == [Label.TRIVIAL] * 3 + [Label.UNSOLVABLE] * 2
    np.testing.assert_array_equal(succeeds(result.record.done, result.record.goal), [True] * 3 + [False] * 2)
    assert not np.any(result.record.action)
    assert not any(np.any(x[..., 3:]) for x in jax.tree.leaves(result.record))
