"""Planning of units, and the scheduler: every missing level is made once; attempts and quarantine."""

import tracemalloc
from collections.abc import Collection, Iterable, Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.experts.steps import EnvSteps, Seconds
from levelproof.pipeline.jobs.schedule import (
    MAX_UNITS,
    Cut,
    Round,
    Scheduler,
    Summary,
    UnitOutcome,
    WorkUnit,
    levels_text,
    plan_units,
    schedule,
)


@given(st.integers(0, 200), st.integers(1, 100), st.sets(st.integers(0, 300)), st.integers(1, 40))
def test_plan_units_cover_what_is_left_once_and_never_cross_a_multiple(
    first: int, count: int, done: set[int], unit: int
) -> None:
    wanted = range(first, first + count)
    units = list(plan_units(wanted, done, unit))
    planned = [level_id for work in units for level_id in work.level_ids]
    assert planned == sorted(set(wanted) - done)
    for work in units:
        assert len({level_id // unit for level_id in work.level_ids}) == 1


@given(st.integers(1, 60), st.integers(1, 20), st.data())
def test_plan_units_cut_at_the_same_ids_for_any_first_level(count: int, unit: int, data: st.DataObject) -> None:
    start = unit * data.draw(st.integers(0, 5))
    whole = {work.name for work in plan_units(range(start + unit * count), set(), unit)}
    assert {work.name for work in plan_units(range(start, start + unit * count), set(), unit)} <= whole


@given(st.integers(1, 60), st.integers(1, 20), st.sets(st.integers(0, 59)))
def test_plan_units_give_new_names_to_what_is_left(count: int, unit: int, committed: set[int]) -> None:
    """A fragment contains the first and the last level of its name, so what is left never needs a committed name."""
    units = list(plan_units(range(count), set(), unit))
    kept = [work for i, work in enumerate(units) if i in committed]
    done = {level_id for work in kept for level_id in work.level_ids}
    assert not {work.name for work in kept} & {work.name for work in plan_units(range(count), done, unit)}


def scheduler_of(levels: int, unit: int, workers: int = 0) -> Scheduler:
    scheduler = Scheduler(plan_units(range(levels), set(), unit), levels, unit)
    for worker in range(workers):
        scheduler.join(worker, 0.0)
    return scheduler


def finished(units: Iterable[WorkUnit], wants: int = 1000) -> Round:
    return Round([UnitOutcome(unit) for unit in units], {}, wants)


def drain(scheduler: Scheduler, workers: int, kills: Collection[int]) -> tuple[list[int], int]:
    """Run workers, which die of the levels in `kills`; return the finished levels and the number of deaths."""
    done, deaths = [], 0
    while not scheduler.over:
        for worker in range(workers):
            if worker not in scheduler.workers:
                scheduler.join(worker, 0.0)
            scheduler.order(worker, 0.0)
        for worker in range(workers):
            running = list(scheduler.workers[worker].units)
            if any(level_id in kills for unit in running for level_id in unit.level_ids):
                deaths += 1
                for outcome in scheduler.lost(worker, "died"):
                    scheduler.failed(outcome.unit)
            else:
                done += [level_id for unit in running for level_id in unit.level_ids]
                scheduler.report(worker, finished(running), 0.0)
    return sorted(done), deaths


@given(st.integers(1, 400), st.integers(1, 3), st.integers(1, 4), st.sets(st.integers(0, 400), max_size=5))
def test_scheduler_quarantines_only_units_that_kill_their_worker(
    levels: int, unit: int, workers: int, kills: set[int]
) -> None:
    scheduler = scheduler_of(levels, unit)
    done, deaths = drain(scheduler, workers, kills)
    given_up = {level_id for unit in scheduler.quarantined for level_id in unit.level_ids}
    assert all(kills.intersection(unit.level_ids) for unit in scheduler.quarantined)
    assert kills & set(range(levels)) <= given_up
    assert sorted([*done, *given_up]) == list(range(levels))
    assert deaths <= len(MAX_UNITS) * len(scheduler.quarantined)


def test_scheduler_gives_failed_units_fewer_companions_each_time() -> None:
    scheduler = scheduler_of(100, 1, workers=1)
    scheduler.report(0, finished([]), 0.0)
    for attempt, most in enumerate(MAX_UNITS):
        while True:  # units with fewer failures come first, and never share a worker with those that have more
            units = scheduler.order(0, 0.0).units
            (attempts,) = {scheduler.attempts.get(unit, 0) for unit in units}
            if attempts == attempt:
                break
            scheduler.report(0, finished(units), 0.0)
        assert len(units) == most
        for outcome in scheduler.lost(0, "died"):
            assert scheduler.failed(outcome.unit) == (most == MAX_UNITS[-1])
        scheduler.join(0, 0.0)
        scheduler.report(0, finished([]), 0.0)
    assert len(scheduler.quarantined) == MAX_UNITS[-1]


def test_scheduler_orders_units_while_a_worker_has_room() -> None:
    scheduler = scheduler_of(12, 4, workers=1)
    (first,) = scheduler.order(0, 0.0).units  # a worker without units gets one, whatever its room
    assert not scheduler.order(0, 0.0).units
    scheduler.report(0, Round([], {first: (0, 0.0, 0)}, wants=2), 0.0)
    (second,) = scheduler.order(0, 0.0).units
    scheduler.report(0, Round([UnitOutcome(first)], {}, wants=0), 0.0)
    assert not scheduler.order(0, 0.0).units
    assert [outcome.unit for outcome in scheduler.lost(0, "died")] == [second]
    scheduler.join(0, 0.0)
    assert scheduler.order(0, 0.0).units  # its replacement starts without units


def test_scheduler_cuts_units_to_a_workers_share_towards_the_end() -> None:
    scheduler = scheduler_of(160, 32, workers=2)
    sizes = []
    while not scheduler.over:
        for worker in range(2):
            units = scheduler.order(worker, 0.0).units
            sizes += [len(unit.level_ids) for unit in units]
            scheduler.report(worker, finished(scheduler.workers[worker].units, wants=1), 0.0)
    assert sizes == [32, 32, 32, 32, 16, 8, 4, 4]
    assert scheduler_of(160, 32, workers=1).order(0, 0.0).units[0].level_ids == range(32)


def test_scheduler_moves_unstarted_levels_to_idle_workers() -> None:
    scheduler = scheduler_of(32, 32, workers=1)
    (unit,) = scheduler.order(0, 0.0).units
    scheduler.report(0, Round([], {unit: (0, 0.0, 0)}, wants=0, spare=24), 0.0)
    scheduler.share()
    assert scheduler.order(0, 0.0).give == 0, "no worker is idle"
    scheduler.join("idle", 0.0)
    assert scheduler.order("idle", 0.0).units == []
    scheduler.share()
    assert scheduler.order(0, 0.0).give == 12
    kept, back = unit.only(range(20)), unit.only(range(20, 32))
    scheduler.report(0, Round([], {}, wants=100, spare=12, cuts=[Cut(unit, kept, back)]), 0.0)
    assert not scheduler.order(0, 0.0).units, "the worker that gave levels back does not get them again"
    (part,) = scheduler.order("idle", 0.0).units
    assert part.level_ids == (20, 21, 22, 23, 24, 25)  # half of them; the other half waits for the next request
    assert [*scheduler.workers[0].units] == [kept]


def test_scheduler_counts_no_failure_for_leaving_workers_and_lists_silent_ones() -> None:
    scheduler = scheduler_of(8, 4, workers=2)
    first, second = (scheduler.order(worker, 1.0).units[0] for worker in (0, 1))
    assert scheduler.silent(1.0) == []
    scheduler.report(1, Round([], {second: (0, 0.0, 0)}, 0), 5.0)
    assert scheduler.silent(4.0) == [0]
    scheduler.leave(0)
    assert not scheduler.attempts
    assert scheduler.first == 0
    scheduler.report(1, finished([second]), 6.0)
    assert {i for unit in scheduler.order(1, 6.0).units for i in unit.level_ids} >= set(first.level_ids)


def test_scheduler_memory_does_not_grow_with_waiting_levels() -> None:
    """Units of a million levels are created only when they are ordered."""
    tracemalloc.start()
    scheduler = Scheduler(plan_units(range(2**20), [], 32), 2**20, 32)
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert before < 2**20 // 8, "bytes"
    assert scheduler.waiting == 2**20


def timed(units: Iterable[WorkUnit], each: float, wants: int = 0) -> Round:
    """Return a round in which these units are committed, and each level took `each` seconds."""
    took = lambda unit: Summary(len(unit.level_ids), 0, EnvSteps(), Seconds(training=each * len(unit.level_ids)))
    return Round([UnitOutcome(unit, took(unit)) for unit in units], {}, wants)


def run_through(scheduler: Scheduler, each: Sequence[float]) -> list[WorkUnit]:
    """Commit all units of a job with one worker per entry of `each`, its seconds per level; return the units."""
    units: list[WorkUnit] = []
    for worker in range(len(each)):
        scheduler.join(worker, 0.0)
    while not scheduler.over:
        for worker, seconds in enumerate(each):
            units += (new := scheduler.order(worker, 0.0).units)
            scheduler.report(worker, timed(new, seconds), 0.0)
    return units


@settings(max_examples=30, deadline=None)
@given(
    st.integers(7000, 10_000),  # around the end of a stretch
    st.integers(1, 3000),
    st.sets(st.integers(7000, 13_000), max_size=20),
    st.lists(st.floats(0.01, 100.0), min_size=1, max_size=3),
)
def test_timed_units_cover_what_is_left_once_under_names_of_their_own(
    first: int, count: int, done: set[int], each: list[float]
) -> None:
    wanted = range(first, first + count)
    done &= set(wanted)
    units = run_through(schedule(wanted, done, count - len(done), 32, timed=True), each)
    assert sorted(level_id for unit in units for level_id in unit.level_ids) == sorted(set(wanted) - done)
    assert len({unit.name for unit in units}) == len(units)
    most = max(1, (count - len(done)) // (4 * len(each)))
    assert max((len(unit.level_ids) for unit in units), default=0) <= most


def test_timed_job_continues_with_units_of_other_sizes_after_a_kill() -> None:
    before = run_through(schedule(range(2000), [], 2000, 32, timed=True), [0.5, 0.5])
    done = [level_id for unit in before[: len(before) // 2] for level_id in unit.level_ids]
    after = run_through(schedule(range(2000), done, 2000 - len(done), 32, timed=True), [5.0])
    assert sorted([*done, *(level_id for unit in after for level_id in unit.level_ids)]) == list(range(2000))
    assert not {unit.name for unit in after} & {unit.name for unit in before[: len(before) // 2]}


def test_timed_units_take_20_to_60_seconds_and_untimed_ones_keep_their_size() -> None:
    sizes = [len(unit.level_ids) for unit in run_through(schedule(range(8192), [], 8192, 32, timed=True), [0.5])]
    assert sizes[:3] == [32, 80, 80]
    untimed = [len(unit.level_ids) for unit in run_through(schedule(range(8192), [], 8192, 64, timed=False), [0.5])]
    assert untimed[:3] == [64, 64, 64]


def test_range_stays_a_range_in_every_timed_unit() -> None:
    units = run_through(schedule(range(20_000), [], 20_000, 32, timed=True), [0.05])
    assert all(isinstance(unit.level_ids, range) for unit in units)


def test_level_that_always_fails_takes_no_more_than_an_untimed_unit_into_quarantine() -> None:
    scheduler, bad = schedule(range(8192), [], 8192, 32, timed=True), 5000
    scheduler.join(0, 0.0)
    while not scheduler.over:
        units = scheduler.order(0, 0.0).units
        failed = [unit for unit in units if bad in unit.level_ids]
        done = timed([unit for unit in units if unit not in failed], 0.1).outcomes
        scheduler.report(0, Round([*done, *(UnitOutcome(unit, reason="bad") for unit in failed)], {}, 0), 0.0)
        for unit in failed:
            scheduler.failed(unit)
    (unit,) = scheduler.quarantined
    assert bad in unit.level_ids
    assert len(unit.level_ids) <= 32


def test_levels_text_lists_runs_of_ids() -> None:
    assert levels_text([WorkUnit((7,))]) == "level 7"
    assert levels_text([WorkUnit((4, 5)), WorkUnit((2, 3)), WorkUnit((9,))]) == "levels 2 to 5, 9"
    assert levels_text([WorkUnit((i,)) for i in range(0, 20, 2)]) == "levels 0, 2, 4, 6 and 6 more runs of levels"


def test_units_of_ids_far_apart_take_many_levels() -> None:
    """Those of level files, labelled from their files or grown from seeds that have them."""
    units = list(plan_units([5, 10**9, 2 * 10**9], [5], 2, {}))
    assert units == [WorkUnit((10**9, 2 * 10**9))]
