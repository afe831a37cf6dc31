"""Speedup of two workers over one, on two cores.

The speedup is of the same job with `workers=1` and `workers=2`, in turns, from the start of the first worker until all
is committed. That excludes the start of Ray and Python, but includes loading compiled programs and the tail, when one
worker is idle. Its upper bound is measured beside it: a worker's loop without Ray or a driver, in one process and in
two at once, which only the shared machine slows down.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import ROUND, STRETCH, Order, Scheduler, UnitOutcome, WorkUnit, plan_units
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.split import writing

LOAD_TIMEOUT = 600.0  # s that a process waits for the others to load their programs
TIMED_UNITS = 8  # units that a process times, after one that loads its programs


class Timed(Scheduler):
    """Scheduler that notes when its first worker joined."""

    began = 0.0

    def join(self, worker: Any, now: float) -> None:
        self.began = self.began or time.monotonic()
        super().join(worker, now)


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", default="s", help="default: s")
    parser.add_argument("--budget", default="64k", help="default: 64k")
    parser.add_argument("--levels", type=int, default=1024, help="levels of the job; default: 1024")
    parser.add_argument("--repeats", type=int, default=2, help="pairs of runs, at least 1; default: 2")


def run(args: argparse.Namespace) -> Report:
    if len(own_cores()) < 2:
        raise UserError("Two workers need two cores: run this on a machine that has them.")
    settings = [f"size={args.size}", f"budget={args.budget}", f"levels={args.levels}", "first_level=1000000"]
    pairs = [tuple(args.levels / seconds_of(settings, workers) for workers in (1, 2)) for _ in range(args.repeats)]
    ratios = [two / one for one, two in pairs]
    shared = [tuple(side_by_side(settings, processes) for processes in (1, 2)) for _ in range(2 * args.repeats)]
    bounds = [2 * one / two for one, two in shared]
    results = [{"size": args.size, "budget": args.budget, "one": one, "two": two} for one, two in pairs]
    results += [{"size": args.size, "budget": args.budget, "alone": one, "beside": two} for one, two in shared]
    rows = [[f"{one:.2f}", f"{two:.2f}", f"{two / one:.2f}"] for one, two in pairs]
    apart = [[f"{one:.1f}", f"{two:.1f}", f"{result:.2f}"] for (one, two), result in zip(shared, bounds, strict=True)]
    return Report(
        title="One worker and two",
        results=results,
        tables=[
            Table(("levels/s, one worker", "two workers", "ratio"), rows, f"A job of {args.levels} levels of size "
                  f"{args.size}, {args.budget} env steps each, on two cores"),
            Table(("s, one process", "each of two at once", "two for one"), apart, f"{TIMED_UNITS} units of the job in "
                  "processes that share nothing but the machine"),
        ],
        notes=[
            f"Two workers are {np.median(ratios):.2f} times as fast as one, two processes that share nothing "
            f"{np.median(bounds):.2f} times{' (medians)' * (args.repeats > 1)}."
        ],
    )  # fmt: skip


def seconds_of(settings: Sequence[str], workers: int) -> float:
    """Return the seconds of a job with `workers` workers, in its own process."""
    with tempfile.TemporaryDirectory() as out:
        (seconds,) = values_of(work, [([*settings, f"workers={workers}", f"out={out}"],)])
    return seconds


def values_of(target: Callable[..., None], each: Sequence[tuple[Any, ...]]) -> list[float]:
    """Run `target` in concurrent processes, one for each tuple of arguments; return their values."""
    context = multiprocessing.get_context("spawn")
    values = context.SimpleQueue()
    processes = [context.Process(target=target, args=(*arguments, values)) for arguments in each]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    if any(process.exitcode for process in processes):
        raise Failure("A process of this benchmark failed: see above.")
    return [values.get() for _ in processes]


def work(settings: Sequence[str], values: Any) -> None:
    """Do the job as `levelproof generate` does; put its seconds."""
    from levelproof.pipeline.jobs import cluster

    job = compose_job(settings)
    count = len(job.level_ids)
    with stoppable() as stop, writing(job, print) as (split, _), Path("/dev/null").open("w") as nowhere:
        scheduler = Timed(plan_units(job.level_ids, [], STRETCH), count, job.levels_per_unit, timed=True)
        board = Board(Tally(count, 0, 0), Console(file=nowhere))

        def settle(outcomes: Sequence[UnitOutcome]) -> None:
            require_done(outcomes)
            for outcome in outcomes:
                board.ended(outcome.unit, outcome.summary)

        cluster.run(job, split, scheduler, settle, board, stop)
        values.put(time.monotonic() - scheduler.began)


def side_by_side(settings: Sequence[str], processes: int) -> float:
    """Return the mean seconds of concurrent processes, each on its own core."""
    ready = multiprocessing.get_context("spawn").Barrier(processes, timeout=LOAD_TIMEOUT)
    with tempfile.TemporaryDirectory() as folder:
        each = [([*settings, f"out={folder}/{core}"], core, ready) for core in own_cores()[:processes]]
        return float(np.mean(values_of(work_alone, each)))


def work_alone(settings: Sequence[str], core: int, ready: Any, values: Any) -> None:
    """Do the job's first units by a worker's loop without a driver; put their seconds."""
    prepare_jax(core)
    from levelproof.pipeline.jobs.worker import Worker  # imports modules that read these settings

    job = compose_job(settings)
    first, *units = islice(plan_units(job.level_ids, [], job.levels_per_unit), 1 + TIMED_UNITS)
    with writing(job, print) as (split, _):
        worker = Worker(job, split)
        finish(worker, [first])
        ready.wait()
        start = time.monotonic()
        finish(worker, units)
        values.put(time.monotonic() - start)


def finish(worker: Any, units: list[WorkUnit]) -> None:
    """Work until these units are committed."""
    round = worker.work(Order(units), ROUND)
    require_done(round.outcomes)
    while round.totals:
        round = worker.work(Order([]), ROUND)
        require_done(round.outcomes)


def require_done(outcomes: Sequence[UnitOutcome]) -> None:
    """Raise Failure if an attempt failed, as its seconds would not count."""
    for outcome in outcomes:
        if not outcome.summary:
            raise Failure(outcome.reason)
