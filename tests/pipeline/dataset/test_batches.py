"""Batches: every trajectory once an epoch, from any position on, read ahead by threads that end."""

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


def seen(batches: Batches) -> list[tuple[int, int]]:
    """(level id, first step) of all that is no repetition."""
    return [
        (level, first)
        for batch in batches
        for level, first, new in zip(batch.level_id.tolist(), batch.first.tolist(), batch.mask.any(1), strict=True)
        if new
    ]


def test_every_trajectory_comes_once_in_an_order_of_the_seed(data: Dataset) -> None:
    first, again, other = (seen(data.batches(8, **PLAIN | {"seed": seed})) for seed in (3, 3, 4))
    assert first == again != other
    assert sorted(first) == sorted(other) == [(i, 0) for i in data.manifest["level_id"].to_pylist()]
    assert seen(data.batches(8, observation=None)) == sorted(first)


def test_epochs_have_orders_of_their_own(data: Dataset) -> None:
    both, n = seen(data.batches(8, epochs=2, **PLAIN)), len(data)
    assert both[:n] != both[n:]
    assert sorted(both[:n]) == sorted(both[n:])


def test_parts_share_nothing(data: Dataset) -> None:
    train, validation = (seen(data.batches(8, subset=subset, **PLAIN)) for subset in ("train", "validation"))
    assert len(train) > len(validation) > 0
    assert sorted(train + validation) == [(i, 0) for i in data.manifest["level_id"].to_pylist()]


def test_windows_of_all_trajectories(data: Dataset) -> None:
    found = seen(data.batches(16, length=100, **PLAIN))
    assert sorted(found) == [(i, first) for i in data.manifest["level_id"].to_pylist() for first in (0, 100, 200)]


def test_hosts_have_as_many_batches_and_share_the_trajectories(data: Dataset) -> None:
    hosts = [data.batches(4, process_index=i, process_count=3, **PLAIN) for i in range(3)]
    batches = [list(host) for host in hosts]
    assert len({len(own) for own in batches}) == 1
    ids = [batch.level_id[batch.mask.any(1)] for own in batches for batch in own]
    assert sorted(np.concatenate(ids).tolist()) == data.manifest["level_id"].to_pylist()


def test_it_goes_on_where_it_was(data: Dataset) -> None:
    batches = data.batches(8, epochs=3, **PLAIN)
    for _ in range(4):
        next(batches)
    state = json.loads(json.dumps(batches.state()))
    rest = seen(batches)
    assert seen(data.batches(8, epochs=3, start=state, **PLAIN)) == rest
    assert rest


def test_a_position_among_other_batches_is_refused(data: Dataset) -> None:
    state = data.batches(8, **PLAIN).state()
    with pytest.raises(UserError, match="The start is a position among other batches \\(seed was 3, now 4\\)"):
        data.batches(8, start=state, observation=None, seed=4)
    with pytest.raises(UserError, match="The start is no position of batches"):
        data.batches(8, start={"step": 3})


def test_threads_end_when_nobody_wants_batches_any_more(data: Dataset) -> None:
    batches = data.batches(4, epochs=None, **PLAIN)
    next(batches)
    assert readers()
    del batches
    gc.collect()
    wait_until(lambda: not readers(), 10, "threads still read")


def test_so_many_are_read_ahead_and_no_more() -> None:
    asked, go = [], threading.Event()

    def load(position: int):
        asked.append(position)
        go.wait(patience(10))
        return position

    batches = Batches(load, None, {}, 3, None)  # type: ignore[arg-type]
    go.set()
    assert next(batches) == 0
    wait_until(lambda: len(asked) >= 4, 10, asked)
    time.sleep(0.1)  # in which no more are asked for
    assert sorted(asked) == [0, 1, 2, 3]
    batches.close()
    with pytest.raises(StopIteration):
        next(batches)


@pytest.mark.campaign
def test_memory_is_bounded_however_much_is_read(data: Dataset) -> None:
    """A million trajectories of a split that is read many times."""

    def resident() -> int:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096

    batches, sizes = data.batches(256, epochs=None, **PLAIN), []
    for number in range(1_000_000 // 256):
        next(batches)
        if number % 100 == 0:
            sizes.append(resident())
    assert sizes[-1] < 1.1 * max(sizes[:5])
