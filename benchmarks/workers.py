"""How much faster two workers are than one, on two cores; and what the driver needs for a thousand of them.

The first is the same job with `workers=1` and `workers=2`, in turns, from when its first worker has begun until
everything is committed: the start of Ray and of Python is not in it, loading compiled programs and the end, when one
worker has nothing left, are. What two cores can give is measured beside it: a worker's loop alone, without Ray and
without a driver, in one process and in two at once that share nothing; that they slow each other down is the machine's
doing. The last is the scheduler alone, with workers that are simulated: as many seconds of its own, and bytes, as it
takes to hand out all units and hear all reports.
"""

import argparse
import heapq
import multiprocessing
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import ROUND, STRETCH, Order, Round, Scheduler, UnitOutcome, WorkUnit, plan_units
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.split import writing

UNIT = 32  # levels
WORKERS, UNITS = 1_000, (2_000, 20_000, 200_000)  # simulated
SECONDS = 6.0  # that a simulated unit takes, on average; of each worker a rate of its own, so that some are slow
POLL = 0.25  # s
PATIENCE = 600.0  # s that a process waits for another to load its programs
BESIDE = 8  # units of the job that a process works through alone, after one that loads its programs
SPREAD = 0.5  # of the logarithm of those rates


class Timed(Scheduler):
    """Knows when the first worker began."""

    began = 0.0

    def join(self, worker: Any, now: float) -> None:
        self.began = self.began or time.monotonic()
        super().join(worker, now)


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", default="s", help="default: s")
    parser.add_argument("--budget", default="64k", help="default: 64k")
    parser.add_argument("--levels", type=int, default=1024, help="of the job; default: 1024")
    parser.add_argument("--repeats", type=int, default=2, help="pairs of runs; default: 2, 0: the scheduler alone")


def run(args: argparse.Namespace) -> Report:
    simulated = [simulate(units) for units in UNITS]
    words = [f"size={args.size}", f"budget={args.budget}", f"levels={args.levels}", "first_level=1000000"]
    pairs = [tuple(args.levels / seconds_of(words, workers) for workers in (1, 2)) for _ in range(args.repeats)]
    ratios = [two / one for one, two in pairs]
    shared = [tuple(beside(words, processes) for processes in (1, 2)) for _ in range(2 * args.repeats)]
    most = [2 * one / two for one, two in shared]
    results = [{"workers": WORKERS, **of} for of in simulated]
    results += [{"size": args.size, "budget": args.budget, "one": one, "two": two} for one, two in pairs]
    results += [{"size": args.size, "budget": args.budget, "alone": one, "beside": two} for one, two in shared]
    rows = [[f"{one:.2f}", f"{two:.2f}", f"{two / one:.2f}"] for one, two in pairs]
    apart = [[f"{one:.1f}", f"{two:.1f}", f"{of:.2f}"] for (one, two), of in zip(shared, most, strict=True)]
    of_driver = [
        [
            f"{of['units']:,}",
            f"{1e6 * of['seconds'] / of['units']:.0f}",
            f"{of['share']:.1%}",
            f"{of['bytes'] / 1e6:.1f}",
        ]
        for of in simulated
    ]
    return Report(
        title="One worker, two workers, a thousand",
        results=results,
        tables=[
            Table(("levels/s, one worker", "two workers", "ratio"), rows, f"A job of {args.levels} levels of size "
                  f"{args.size}, {args.budget} env steps each, on two cores"),
            Table(("s, one process", "each of two at once", "two for one"), apart, f"{BESIDE} units of the job in "
                  "processes that share nothing but the machine"),
            Table(
                ("units", "µs of the driver a unit", "of one core, while they work", "most MB"),
                of_driver,
                f"The scheduler with {WORKERS:,} simulated workers, units of {UNIT} levels and {SECONDS:.0f} s",
            ),
        ],
        notes=[
            f"Two workers are {np.median(ratios):.2f} times as fast as one, two processes that share nothing "
            f"{np.median(most):.2f} times (medians)."
        ]
        if ratios
        else [],
    )  # fmt: skip


def seconds_of(words: Sequence[str], workers: int) -> float:
    """Of a job with so many workers, in a process of its own."""
    with tempfile.TemporaryDirectory() as out:
        (seconds,) = told_by(work, [([*words, f"workers={workers}", f"out={out}"],)])
    return seconds


def told_by(target: Callable[..., None], each: Sequence[tuple[Any, ...]]) -> list[float]:
    """What processes tell that run at once, one with each of these arguments."""
    context = multiprocessing.get_context("spawn")
    told = context.SimpleQueue()
    processes = [context.Process(target=target, args=(*arguments, told)) for arguments in each]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    if any(process.exitcode for process in processes):
        raise Failure("A process of this benchmark failed: see above.")
    return [told.get() for _ in processes]


def work(words: Sequence[str], told: Any) -> None:
    """The job, as `levelproof generate` does it."""
    from levelproof.pipeline.jobs import cluster

    job = compose_job(words)
    count = len(job.level_ids)
    with stoppable() as stop, writing(job, print) as (split, _), Path("/dev/null").open("w") as nowhere:
        scheduler = Timed(plan_units(job.level_ids, [], STRETCH), count, job.levels_per_unit, timed=True)
        board = Board(Tally(count, 0, 0), Console(file=nowhere))

        def settle(outcomes: Sequence[UnitOutcome]) -> None:
            require_done(outcomes)
            for outcome in outcomes:
                board.ended(outcome.unit, outcome.summary)

        cluster.run(job, split, scheduler, settle, board, stop)
        told.put(time.monotonic() - scheduler.began)


def beside(words: Sequence[str], processes: int) -> float:
    """Seconds of each of so many processes at once, on average, each on a core of its own."""
    ready = multiprocessing.get_context("spawn").Barrier(processes, timeout=PATIENCE)
    with tempfile.TemporaryDirectory() as folder:
        each = [([*words, f"out={folder}/{core}"], core, ready) for core in own_cores()[:processes]]
        return float(np.mean(told_by(work_alone, each)))


def work_alone(words: Sequence[str], core: int, ready: Any, told: Any) -> None:
    """The job's first units, by a worker's loop that nobody drives."""
    prepare_jax(core)
    from levelproof.pipeline.jobs.worker import Worker  # imports what reads the settings just made

    job = compose_job(words)
    first, *units = islice(plan_units(job.level_ids, [], job.levels_per_unit), 1 + BESIDE)
    with writing(job, print) as (split, _):
        worker = Worker(job, split)
        finish(worker, [first])
        ready.wait()
        begun = time.monotonic()
        finish(worker, units)
        told.put(time.monotonic() - begun)


def finish(worker: Any, units: list[WorkUnit]) -> None:
    """Work until these units are committed."""
    round = worker.work(Order(units), ROUND)
    require_done(round.outcomes)
    while round.totals:
        round = worker.work(Order([]), ROUND)
        require_done(round.outcomes)


def require_done(outcomes: Sequence[UnitOutcome]) -> None:
    """Raises Failure where an attempt has failed: its seconds would count for nothing."""
    for outcome in outcomes:
        if not outcome.summary:
            raise Failure(outcome.reason)


def simulate(units: int) -> dict[str, float]:
    """What the scheduler takes for so many units of WORKERS workers, one of which dies for every thousand units."""
    seconds, simulated = schedule(units)
    tracemalloc.start()  # by itself: it slows everything down
    schedule(units)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"units": units, "seconds": seconds, "bytes": most, "share": seconds / simulated}


def schedule(units: int) -> tuple[float, float]:
    """Seconds of the scheduler, and seconds that pass for the workers."""
    rng, levels = np.random.default_rng(0), units * UNIT
    rates = np.exp(rng.normal(0, SPREAD, WORKERS)) * UNIT / SECONDS  # levels/s
    scheduler = Scheduler(plan_units(range(levels), [], UNIT), levels, UNIT)
    done, worked, now, share_at = np.zeros(WORKERS), 0.0, 0.0, 0.0  # levels since its last unit ended
    events = [(float(of), worker) for worker, of in enumerate(rng.random(WORKERS))]
    heapq.heapify(events)
    for _, worker in events:
        scheduler.join(worker, 0.0)
    while not scheduler.over:
        now, worker = heapq.heappop(events)
        done[worker] += rates[worker] * ROUND
        start = time.process_time()
        ended, running = [], dict(scheduler.workers[worker].units)
        for unit in running:
            if len(unit.level_ids) > done[worker]:
                break
            done[worker] -= len(unit.level_ids)
            ended.append(UnitOutcome(unit))
        if rng.random() < ROUND / SECONDS / 1000:
            for outcome in scheduler.lost(worker, "died"):
                scheduler.failed(outcome.unit)
            scheduler.join(worker, now)
        else:
            scheduler.report(worker, Round(ended, {}, wants=UNIT // 4 if len(running) - len(ended) < 2 else 0), now)
        if now >= share_at:  # as the driver, which looks several times a second
            share_at = now + POLL
            scheduler.share()
        scheduler.order(worker, now)
        worked += time.process_time() - start
        if not scheduler.workers[worker].units:
            done[worker] = 0.0
        heapq.heappush(events, (now + ROUND, worker))
    return worked, now
