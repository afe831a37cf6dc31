"""Sizes of work units: as many levels as keep a worker busy for 20 to 60 seconds, within a share of the job."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levelproof.pipeline.jobs.sizing import MAX_FACTOR, STEP, UNITS_EACH, UnitSize, unit_levels

MANY = 10**9  # levels; so many that a worker's share never limits a unit


@given(st.floats(1e-9, 1e5), st.integers(1, 10**8), st.integers(0, 20_000), st.sampled_from([4, 8, 16, 32]))
def test_unit_takes_20_to_60_seconds_unless_a_limit_holds(
    seconds: float, levels: int, workers: int, untimed: int
) -> None:
    count = unit_levels(seconds, levels, workers, untimed)
    share = levels // (UNITS_EACH * max(workers, 1))
    assert 1 <= count <= max(1, min(share, MAX_FACTOR * untimed))
    if count < min(share, MAX_FACTOR * untimed):
        assert count * seconds >= 20
    if count > 1:
        assert count * seconds <= 60


def test_untimed_unit_is_small_and_no_more_than_a_share() -> None:
    assert unit_levels(None, MANY, 8, 32) == 32
    assert unit_levels(None, 64, 2, 32) == 8
    assert unit_levels(None, 3, 2, 32) == 1


def sized(*units: tuple[int, float]) -> UnitSize:
    """Return the size after units, each with a number of levels and the seconds that each level took."""
    size = UnitSize(MANY, 32)
    for levels, each in units:
        size.note(levels, levels * each, 1.0)
    return size


def test_size_follows_what_levels_take() -> None:
    assert sized((32, 0.5)).now(8, 1.0) == 80
    assert sized((32, 20.0)).now(8, 1.0) == 2
    assert sized(*[(32, 20.0)] * 9, *[(2, 0.5)] * 40).now(8, 1.0) == 2 * STEP


def test_one_unit_that_hangs_changes_no_size() -> None:
    assert sized(*[(80, 0.5)] * 9, (80, 1e4)).now(8, 1.0) == 80


def test_quick_units_that_end_first_let_a_unit_grow_by_steps() -> None:
    assert sized((32, 1e-6)).now(8, 1.0) == 32 * STEP
    assert sized((32, 1e-6), (128, 1e-6)).now(8, 1.0) == 512


def test_slow_worker_gets_small_units_and_a_new_one_an_untimed_unit() -> None:
    size = sized(*[(80, 0.5)] * 9)
    assert size.now(8, None) == 32
    slowness = size.note(32, 32 * 2.5, None)
    assert slowness == pytest.approx(5.0)
    assert size.now(8, slowness) == 16
    assert size.note(0, 0.0, slowness) == slowness
