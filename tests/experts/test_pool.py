"""Threads that share a pool: each gets what it would have got alone, and none waits for ever."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import jax
import numpy as np
import pytest

from experts import pool as pool_module
from experts.judge import Trained
from experts.pool import Pool, capacity_of
from experts.queue import empty_queue, enter, next_places
from experts.witness import take
from levelgen.level import SIZES, Level
from levelgen.sampling.sampler import sample_levels
from levelgen.task.rules import DEFAULT_RULES
from tests.experts.test_slots import CONFIG, SOLVED, same

IDS = np.arange(100, 136)
UPDATES = 6


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def alone(levels: Level) -> list[Trained]:
    return new_pool().train(levels, IDS)[0]


def new_pool() -> Pool:
    return Pool(UPDATES, CONFIG, SOLVED, DEFAULT_RULES)


def part(levels: Level, at: range) -> tuple[Level, np.ndarray]:
    return take(levels, np.array(at, int)), IDS[np.array(at, int)]


def test_threads_get_what_each_would_get_alone(levels: Level, alone: list[Trained]) -> None:
    """More levels come than the queue has places, so places are used again."""
    assert capacity_of(CONFIG) < len(IDS)
    pool, parts = new_pool(), [range(20), range(20, 23), range(23, 36), range(0)]
    with ThreadPoolExecutor(len(parts)) as threads:
        found = list(threads.map(lambda at: pool.train(*part(levels, at)), parts))
    trained = [of for some, _ in found for of in some]
    assert len(trained) == len(IDS)
    same(trained, alone)
    for (some, spent), at in zip(found, parts, strict=True):
        assert len(some) == len(at)
        assert spent.trained == sum(len(of.curve) for of in some) * CONFIG.steps_per_update


def test_levels_that_come_later_take_the_slots_that_are_empty(levels: Level) -> None:
    """One level keeps one slot busy; those of a second thread come while it trains, into the other."""
    pool, second = new_pool(), []

    def add(env_steps: int, through: float, solved: int) -> None:
        if not second:
            second.append(threads.submit(lambda: pool.train(*part(levels, range(1, 4)))))
            while pool.wants:  # until they wait
                pass

    with ThreadPoolExecutor(1) as threads:
        _, first = pool.train(*part(levels, range(1)), tell=add)
        second[0].result()
    assert first.idle == CONFIG.steps_per_update  # of the first rollout alone


def test_what_is_told_grows_to_the_whole(levels: Level) -> None:
    seen: list[tuple[int, float, int]] = []
    trained, spent = new_pool().train(*part(levels, range(5)), tell=lambda *now: seen.append(now))
    for totals in zip(*seen, strict=True):
        assert list(totals) == sorted(totals)
    assert seen[-1][:2] == (spent.trained, 5)
    assert len(trained) == 5


def test_a_failure_reaches_every_thread(levels: Level, monkeypatch: pytest.MonkeyPatch) -> None:
    pool, calls, together = new_pool(), [], Event()

    def fails(work: Callable) -> Callable:
        def advance(*args: object) -> object:
            calls.append(1)
            together.wait(timeout=30)  # until the second thread has come
            if len(calls) == 3:
                raise MemoryError("no room on the device")
            return work(*args)

        return advance

    monkeypatch.setattr(pool_module, "advance", fails(pool_module.advance))
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(lambda: pool.train(*part(levels, range(4))))
        second = threads.submit(lambda: pool.train(*part(levels, range(4, 8))))
        while pool.wants or len(pool._batches) < 2:
            pass
        together.set()
        errors = [future.exception(timeout=60) for future in (first, second)]
    assert sorted(type(error).__name__ for error in errors) == ["MemoryError", "RuntimeError"]
    assert "no room on the device" in str(errors)
    with pytest.raises(RuntimeError, match="no room on the device"):
        pool.train(*part(levels, range(1)))


def test_a_pool_wants_levels_while_fewer_wait_than_there_are_slots(levels: Level) -> None:
    pool = new_pool()
    assert pool.wants == 2
    wanted: list[int] = []
    pool.train(*part(levels, range(5)), tell=lambda *now: wanted.append(pool.wants))
    assert wanted[0] == 0  # three wait
    assert wanted == sorted(wanted)
    assert pool.wants == 2


def test_places_of_a_queue_go_round(levels: Level) -> None:
    queue = empty_queue(levels, 20, 1, CONFIG)
    for at in (range(12), range(12, 24)):
        some, ids = part(levels, at)
        assert next_places(queue, len(ids)) == [i % 20 for i in at]
        queue = enter(queue, some, ids, CONFIG)
    assert int(queue.count) == 24
    expected = [*IDS[20:24], *IDS[4:20]]
    np.testing.assert_array_equal(queue.level_ids, expected)
    same(jax.device_get(queue.levels), take(levels, np.array(expected) - IDS[0]))
