"""`Dataset.batches`: every trajectory once per epoch, resumable, prefetched by threads that stop."""

import gc
import json
import threading
import time
from typing import Any

import numpy as np
import pytest

from levelproof.pipeline.dataset.batches import Batches
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from tests.pace import patience, wait_until

PLAIN: dict[str, Any] = {"observation": None, "seed": 3}


def readers() -> int:
    return sum(thread.name.startswith("levelproof-reader") for thread in threading.enumerate())


def items_of(batches: Batches) -> list[tuple[int, int]]:
    """Return (level id, first step) of all items that are not padding."""
    return [
        (level, first)
        for batch in batches
        for level, first, new in zip(batch.level_id.tolist(), batch.first.tolist(), batch.mask.any(1), strict=True)
        if new
    ]


def test_batches_yield_each_trajectory_once_in_an_order_set_by_the_seed(data: Dataset) -> None:
    first, again, other = (items_of(data.batches(8, **PLAIN | {"seed": seed})) for seed in (3, 3, 4))
    assert first == again != other
    assert sorted(first) == sorted(other) == [(i, 0) for i in data.manifest["level_id"].to_pylist()]
    assert items_of(data.batches(8, observation=None)) == sorted(first)


def test_batches_reshuffle_every_epoch(data: Dataset) -> None:
    both, n = items_of(data.batches(8, epochs=2, **PLAIN)), len(data)
    assert both[:n] != both[n:]
    assert sorted(both[:n]) == sorted(both[n:])


def test_batches_of_the_two_subsets_are_disjoint(data: Dataset) -> None:
    train, validation = (items_of(data.batches(8, subset=subset, **PLAIN)) for subset in ("train", "validation"))
    assert len(train) > len(validation) > 0
    assert sorted(train + validation) == [(i, 0) for i in data.manifest["level_id"].to_pylist()]


def test_batches_yield_all_windows_of_all_trajectories(data: Dataset) -> None:
    items = items_of(data.batches(16, length=100, **PLAIN))
    assert sorted(items) == [(i, first) for i in data.manifest["level_id"].to_pylist() for first in (0, 100, 200)]


def test_batches_distribute_trajectories_evenly_over_hosts(data: Dataset) -> None:
    hosts = [data.batches(4, process_index=i, process_count=3, **PLAIN) for i in range(3)]
    batches = [list(host) for host in hosts]
    assert len({len(own) for own in batches}) == 1
    ids = [batch.level_id[batch.mask.any(1)] for own in batches for batch in own]
    assert sorted(np.concatenate(ids).tolist()) == data.manifest["level_id"].to_pylist()


def test_batches_resume_from_their_state(data: Dataset) -> None:
    batches = data.batches(8, epochs=3, **PLAIN)
    for _ in range(4):
        next(batches)
    state = json.loads(json.dumps(batches.state()))
    assert json.loads(json.dumps(data.batches(np.int64(8), length=np.int64(64)).state()))["of"]["length"] == 64
    rest = items_of(batches)
    assert items_of(data.batches(8, epochs=3, start=state, **PLAIN)) == rest
    assert rest


def test_batches_reject_a_state_of_other_settings(data: Dataset) -> None:
    state = data.batches(8, **PLAIN).state()
    with pytest.raises(UserError, match="The start was saved with other settings \\(seed was 3, now 4\\)"):
        data.batches(8, start=state, observation=None, seed=4)
    for no_state in {"step": 3}, state | {"position": -1}, state | {"position": "3"}:
        with pytest.raises(UserError, match="The start is not a state of batches"):
            data.batches(8, start=no_state, observation=None, seed=3)


def test_batches_stop_their_threads_when_collected(data: Dataset) -> None:
    batches = data.batches(4, epochs=None, **PLAIN)
    next(batches)
    assert readers()
    del batches
    gc.collect()
    wait_until(lambda: not readers(), 10, "threads still read")


def test_batches_read_ahead_exactly_prefetch_batches() -> None:
    """The first one is returned while those ahead are still being read."""
    requested, go = [], threading.Event()

    def load(positions: range) -> range:
        requested.extend(positions)
        assert 0 in positions or go.wait(patience(10))
        return positions

    batches = Batches(load, None, {}, 3, None)
    assert next(batches) == 0
    go.set()
    wait_until(lambda: len(requested) >= 4, 10, requested)
    time.sleep(0.1)  # time in which a fifth batch could be requested
    assert sorted(requested) == [0, 1, 2, 3]
    batches.close()
    with pytest.raises(StopIteration):
        next(batches)


def test_batches_loaded_together_stay_within_prefetch() -> None:
    requested: list[int] = []
    batches = Batches(lambda positions: requested.extend(positions) or positions, None, {}, 3, None, together=2)
    for position in range(6):
        assert next(batches) == position
        wait_until(lambda position=position: len(requested) > position + 1, 10, requested)  # something is read ahead
        time.sleep(0.05)  # time in which too much could be requested
        assert len(requested) <= position + 1 + 3
    batches.close()


def test_batches_load_as_many_as_before_at_the_end_and_return_no_more() -> None:
    loaded: list[range] = []
    batches = Batches(lambda positions: loaded.append(positions) or positions, 7, {}, 9, None, together=3)
    assert [*batches] == [*range(7)]
    by_start = sorted(loaded, key=lambda positions: positions.start)  # two threads load
    assert by_start == [range(3), range(3, 6), range(6, 9)]
    few = Batches(lambda positions: loaded.append(positions) or positions, 2, {}, 9, None, together=3)
    assert [*few] == [0, 1]
    assert loaded[3:] == [range(2)], "a single load is as small as it can be"


def test_batches_finish_no_more_than_the_next_two() -> None:
    finished: list[int] = []
    batches = Batches(lambda positions: positions, None, {}, 9, None, 5, lambda x: finished.append(x) or -x)
    for position in range(4):
        assert next(batches) == -position
        wait_until(lambda position=position: len(finished) >= position + 1, 10, finished)
        time.sleep(0.05)  # time in which too many could be finished
        assert finished == [*range(len(finished))]
        assert len(finished) <= position + 2
    batches.close()


def test_batches_that_cannot_be_finished_end_the_iteration() -> None:
    batches = Batches(lambda positions: positions, None, {}, 3, None, finish=lambda x: 6 // (2 - x))
    assert [next(batches), next(batches)] == [3, 6]
    with pytest.raises(ZeroDivisionError):
        next(batches)
    assert batches.state()["position"] == 2, "the one that failed was not returned"
    with pytest.raises(StopIteration):
        next(batches)


def test_batches_before_one_that_cannot_be_loaded_are_returned() -> None:
    for slowly in (False, True):
        failed = threading.Event()

        def load(positions: range, failed: threading.Event = failed) -> range:
            if 2 in positions:
                failed.set()
                raise ValueError("damaged")
            return positions

        batches = Batches(load, None, {}, 4, None)
        assert next(batches) == 0
        if slowly:
            assert failed.wait(patience(10))
            time.sleep(0.05)
        assert next(batches) == 1
        with pytest.raises(ValueError, match="damaged"):
            next(batches)


@pytest.mark.campaign
def test_batches_use_bounded_memory(data: Dataset) -> None:
    """A million trajectories are read, by many epochs of a small split."""

    def resident() -> int:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096

    batches, sizes = data.batches(256, epochs=None, **PLAIN), []
    for number in range(1_000_000 // 256):
        next(batches)
        if number % 100 == 0:
            sizes.append(resident())
    assert sizes[-1] < 1.1 * max(sizes[:5])


def test_negative_epochs_are_refused(data: Dataset) -> None:
    with pytest.raises(UserError, match="epochs is -1: it must be at least 0, or None for endless batches"):
        data.batches(8, epochs=-1)
