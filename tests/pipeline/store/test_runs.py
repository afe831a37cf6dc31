"""Runs of level ids."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from levelproof.pipeline.store.runs import inside, runs, runs_text, without


def test_runs_groups_consecutive_numbers() -> None:
    assert runs([5, 1, 2, 3, 9, 8, 5]) == [(1, 3), (5, 5), (8, 9)]
    assert runs([]) == []
    assert runs(range(64)) == [(0, 63)]


@given(st.sets(st.integers(0, 60)), st.sets(st.integers(0, 60)))
def test_inside_selects_ids_in_runs(wanted: set[int], there: set[int]) -> None:
    ids = np.array(sorted(there), np.int64)
    found = inside(ids, np.array(runs(sorted(wanted)), np.int64).reshape(-1, 2))
    assert set(ids[found].tolist()) == wanted & there


def test_inside_is_fast_for_half_a_million_runs() -> None:
    """Every other level of a million: checking every run for every level would take days."""
    ids = np.arange(1_000_000)
    assert inside(ids, np.stack([ids[::2], ids[::2]], 1)).sum() == 500_000


@given(st.sets(st.integers(0, 60)), st.sets(st.integers(0, 60)))
def test_without_removes_ids_from_runs(wanted: set[int], there: set[int]) -> None:
    left = without(runs(sorted(wanted)), np.array(sorted(there), np.int64))
    assert [i for first, last in left for i in range(first, last + 1)] == sorted(wanted - there)


def test_without_is_fast_for_a_long_run() -> None:
    assert without([(0, 10**15)], np.array([5, 6, 10**15])) == [(0, 4), (7, 10**15 - 1)]


def test_runs_text_describes_runs() -> None:
    assert runs_text([(7, 7)]) == "level 7"
    assert runs_text([(2, 5), (9, 9)]) == "levels 2 to 5, 9"
    assert runs_text([(i, i) for i in range(0, 12, 2)]) == "levels 0, 2, 4, 6 and 2 more runs of levels"
