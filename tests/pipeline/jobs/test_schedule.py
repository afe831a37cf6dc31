"""What is left to do: everything wanted and not done, once; attempts and quarantine."""

from collections import deque
from collections.abc import Collection

from hypothesis import given
from hypothesis import strategies as st

from pipeline.jobs.schedule import (
    COMPANY,
    Assignment,
    Round,
    UnitOutcome,
    UnitQueue,
    WorkUnit,
    levels_text,
    plan_units,
)


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


def drain(queue: UnitQueue, workers: int, kills: Collection[int]) -> tuple[list[int], int]:
    """Levels that got done, and how many workers died, where some levels kill the worker that has them."""
    done, deaths = [], 0
    assignments = [Assignment(wants=1000) for _ in range(workers)]
    while True:
        for assignment in assignments:
            while assignment.take(queue):
                pass
        if not any(assignment.units for assignment in assignments):
            return sorted(done), deaths
        for assignment in assignments:
            running = assignment.units
            if any(level_id in kills for unit in running for level_id in unit.level_ids):
                deaths += 1
                for outcome in assignment.lose("died"):
                    queue.failed(outcome.unit)
            else:
                done += [level_id for unit in running for level_id in unit.level_ids]
                assignment.account(Round([UnitOutcome(unit) for unit in running], {}, wants=1000))


@given(st.integers(1, 400), st.integers(1, 3), st.integers(1, 4), st.sets(st.integers(0, 400), max_size=5))
def test_units_that_kill_their_worker_are_given_up_and_no_other(
    levels: int, unit: int, workers: int, kills: set[int]
) -> None:
    queue = UnitQueue(deque(plan_units(range(levels), set(), unit)))
    done, deaths = drain(queue, workers, kills)
    given_up = {level_id for unit in queue.quarantined for level_id in unit.level_ids}
    assert all(kills.intersection(unit.level_ids) for unit in queue.quarantined)
    assert kills & set(range(levels)) <= given_up
    assert sorted([*done, *given_up]) == list(range(levels))
    assert deaths <= len(COMPANY) * len(queue.quarantined)


def test_company() -> None:
    queue = UnitQueue(deque(plan_units(range(100), set(), 1)))
    running = [unit for _ in range(COMPANY[0]) if (unit := queue.take([]))]
    assert queue.take(running) is None
    fresh = queue.take(running[1:])
    assert fresh is not None
    for unit in running:
        assert not queue.failed(unit)
    assert fresh not in queue.attempts
    assert queue.take([fresh]) not in running  # what has failed joins only what has failed as often
    assert queue.take([running[0]]) == running[0]
    assert queue.take(running[: COMPANY[1]]) is None


def test_a_worker_gets_units_while_it_has_room() -> None:
    queue, assignment = UnitQueue(deque(plan_units(range(12), set(), 4))), Assignment()
    assert assignment.take(queue)  # however little room there is
    assert not assignment.take(queue)
    (first,) = assignment.units
    assignment.account(Round([], {first: (0, 0.0, 0)}, wants=2))
    assert assignment.take(queue)
    assert not assignment.take(queue)
    first, second = assignment.units
    assignment.account(Round([UnitOutcome(first)], {}, wants=0))
    assert assignment.units == [second]
    assert [outcome.unit for outcome in assignment.lose("died")] == [second]
    assert assignment.take(queue)  # the next worker with these resources begins anew


def test_a_unit_that_fails_waits_behind_the_others_until_it_is_given_up() -> None:
    queue = UnitQueue(deque(plan_units(range(4), set(), 2)))
    bad = queue.take()
    assert bad is not None
    assert not queue.failed(bad)
    good = queue.take()
    assert good != bad
    for attempt in range(2, len(COMPANY) + 1):
        assert queue.take() == bad
        assert queue.failed(bad) == (attempt == len(COMPANY))
    assert queue.quarantined == [bad]
    assert queue.take() is None


def test_levels_are_told_in_runs() -> None:
    assert levels_text([WorkUnit((7,))]) == "level 7"
    assert levels_text([WorkUnit((4, 5)), WorkUnit((2, 3)), WorkUnit((9,))]) == "levels 2 to 5, 9"
    assert levels_text([WorkUnit((i,)) for i in range(0, 20, 2)]) == "levels 0, 2, 4, 6 and 6 more runs of levels"
