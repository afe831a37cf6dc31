"""A worker's process, without Ray."""

from types import SimpleNamespace
from typing import Any

from levelproof.pipeline.jobs.actor import WorkerActor
from levelproof.pipeline.jobs.schedule import Order, Round


def test_worker_that_leaves_repeats_a_round_that_the_driver_has_not_heard() -> None:
    rounds, last = [Round([], {}, wants) for wants in (1, 2)], Round([], {}, 0, leaves=True)
    worker: Any = SimpleNamespace(work=lambda *_: rounds[actor._rounds], leave=lambda: last)
    actor = WorkerActor(lambda: False)
    actor._worker, actor._working, actor._rounds = worker, False, 0
    assert actor.leave(0) == [last], "it has not worked yet"
    for round in rounds:
        assert actor.work(Order([]), 1.0) is round
    assert actor.leave(1) == [rounds[1], last]
    assert actor.leave(2) == [last]
