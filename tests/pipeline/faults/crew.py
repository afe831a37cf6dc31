"""A substitute for Ray and training: one forked worker that commits ready-made results of units by the real commit.

Training takes seconds per unit and writes nothing, so it is left out; all code that writes is the real one.
"""

import os
import time
from collections.abc import Callable
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.pipeline.jobs.progress import Board
from levelproof.pipeline.jobs.schedule import Order, Round, Scheduler, Settle, Summary, UnitOutcome, WorkUnit
from levelproof.pipeline.jobs.unit import commit, failure
from levelproof.pipeline.stopping import Stop
from levelproof.pipeline.store.leases import serve, served
from tests.pipeline.made import made_level, made_record, made_verdict

WANTED = 2  # levels for which a worker has room
waiting: list[Connection] = []  # connections to workers that wait for their job


@cache
def result_of(level_ids: tuple[int, ...], experts: bool) -> UnitResult:
    """Return a result of random bits, the same each time."""
    number, seed = len(level_ids), level_ids[0]
    verdicts = [made_verdict(Label.UNSOLVED if i % 3 == 1 else Label.SOLVED) for i in level_ids]
    level, record = made_level("s", number, seed), made_record("s", number, seed)
    weights: Any = {"weights": np.arange(seed, seed + 4.0)}
    kept = {i: KeptExpert(weights, [0.5]) for i in level_ids if experts}
    return UnitResult(np.array(level_ids), level, record, verdicts, EnvSteps(), kept)


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Run all units as an executor does, and replace a worker that dies."""
    worker: Connection | None = None
    while not scheduler.over:
        if worker is None:
            worker = waiting.pop(0)
            worker.send((job, split, served(split)))
            scheduler.join(worker, time.monotonic())
        try:
            worker.send(scheduler.order(worker, time.monotonic()))
            round = worker.recv()
        except (EOFError, ConnectionError):
            settle(scheduler.lost(worker, "The worker died"))
            worker = None
            continue
        scheduler.report(worker, round, time.monotonic())
        board.tally.follow(round)
        settle(round.outcomes)


def fork_worker(begin: Callable[[], None]) -> None:
    """Fork a worker that waits for a job and ends with its driver; call before the driver has locks or connections."""
    mine, theirs = Pipe()
    if os.fork():
        theirs.close()
        waiting.append(mine)
        return
    try:
        for others in [mine, *waiting]:
            others.close()
        job, split, writer = theirs.recv()
        begin()
        serve(split, writer)
        while True:
            order: Order = theirs.recv()
            theirs.send(Round([_done(job, split, unit) for unit in order.units], {}, WANTED))
    except (EOFError, ConnectionError):
        pass
    finally:
        os._exit(0)


def _done(job: JobConfig, split: Path, unit: WorkUnit) -> UnitOutcome:
    try:
        commit(job, split, unit, result_of(tuple(unit.level_ids), job.keep_experts))
    except Exception as error:
        return failure(split, unit, error)
    return UnitOutcome(unit, Summary(len(unit.level_ids), 1, EnvSteps()))
