"""What is left to do: everything wanted and not done, once; attempts and quarantine."""

from hypothesis import given
from hypothesis import strategies as st

from pipeline.schedule import ATTEMPTS, Queue, plan_units


@given(st.integers(0, 200), st.integers(1, 100), st.sets(st.integers(0, 300)), st.integers(1, 40))
def test_units_cover_what_is_left_once_and_never_cross_a_multiple(
    first: int, count: int, done: set[int], unit: int
) -> None:
    wanted = range(first, first + count)
    units = plan_units(wanted, done, unit)
    planned = [level_id for work in units for level_id in work.level_ids]
    assert planned == sorted(set(wanted) - done)
    for work in units:
        assert len({level_id // unit for level_id in work.level_ids}) == 1


@given(st.integers(1, 60), st.integers(1, 20), st.data())
def test_jobs_that_start_elsewhere_cut_at_the_same_places(count: int, unit: int, data: st.DataObject) -> None:
    start = unit * data.draw(st.integers(0, 5))
    whole = {work.name for work in plan_units(range(start + unit * count), set(), unit)}
    assert {work.name for work in plan_units(range(start, start + unit * count), set(), unit)} <= whole


@given(st.integers(1, 60), st.integers(1, 20), st.sets(st.integers(0, 59)))
def test_names_of_what_is_left_are_new(count: int, unit: int, committed: set[int]) -> None:
    """A fragment holds the first and the last level of its name, so what is left never takes a name that is there."""
    units = plan_units(range(count), set(), unit)
    kept = [work for i, work in enumerate(units) if i in committed]
    done = {level_id for work in kept for level_id in work.level_ids}
    assert not {work.name for work in kept} & {work.name for work in plan_units(range(count), done, unit)}


def test_a_unit_that_fails_waits_again_behind_the_others_until_it_is_given_up() -> None:
    queue = Queue.of(plan_units(range(4), set(), 2))
    bad = queue.take(alone=True)
    assert bad is not None
    assert not queue.failed(bad)
    good = queue.take(alone=True)
    assert good != bad
    for attempt in range(1, ATTEMPTS):
        assert queue.take(alone=True) == bad
        assert queue.failed(bad) == (attempt == ATTEMPTS - 1)
    assert queue.quarantined == [bad]
    assert queue.take(alone=True) is None


def test_a_unit_that_has_failed_goes_to_a_worker_that_has_no_other() -> None:
    queue = Queue.of(plan_units(range(3), set(), 1))
    bad = queue.take(alone=False)
    assert bad is not None
    queue.failed(bad)
    fresh = [queue.take(alone=False), queue.take(alone=False)]
    assert bad not in fresh
    assert None not in fresh
    assert queue.take(alone=False) is None
    assert queue.take(alone=True) == bad
