"""The executor without Ray: workers in threads of this process, which compiled code lets run side by side."""

import time
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.jobs.choice import MANY, MAX_THREADS, workers_here
from levelproof.pipeline.jobs.progress import STOPPING, Board
from levelproof.pipeline.jobs.schedule import ROUND, Round, Scheduler, Settle
from levelproof.pipeline.runtime import NO_GPU, jax_sees_a_gpu, own_cores, prepare_jax, spare_imports
from levelproof.pipeline.stopping import Stop

if TYPE_CHECKING:
    from levelproof.pipeline.jobs.ahead import Ahead
    from levelproof.pipeline.jobs.grower import Grower
    from levelproof.pipeline.jobs.worker import Worker

POLL = 0.25  # s between progress updates while threads compile or work


class Handle(NamedTuple):
    """A worker, as the scheduler and the events know it."""

    number: int
    host: str = "this process"


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Run all units in this process, or until a stop is requested."""
    count = workers_here(job, scheduler.waiting)
    prepare_jax(device=job.device, threads=count)
    if job.device == "gpu" and not jax_sees_a_gpu():
        board.say(f"This process uses a CPU core, not a GPU: {NO_GPU}.")
    # These modules read JAX's settings on import, so import them after JAX is set up
    from levelproof.pipeline.jobs.ahead import Ahead
    from levelproof.pipeline.jobs.worker import worker_for

    spare_imports()
    with stop.heeded():
        workers = {Handle(number): worker_for(job, split) for number in range(count)}
        first = next(iter(workers.values()))
        threads = min(len(own_cores()), MAX_THREADS)
        if first.pool and job.device == "cpu" and threads > 1 and scheduler.waiting >= MANY:
            first.compiling = _compile_side_by_side(Ahead(job, first.pool), threads, board, stop)
        if not stop.asked.is_set():  # else no level has begun
            _work(workers, scheduler, settle, board, stop)


def _work(
    workers: "dict[Handle, Worker | Grower]", scheduler: Scheduler, settle: Settle, board: Board, stop: Stop
) -> None:
    """Let each worker make levels in a thread of its own; only this thread touches the scheduler and the board."""

    def report(handle: Handle, round: Round) -> None:
        scheduler.report(handle, round, time.monotonic())
        board.follow(round)
        settle(round.outcomes)

    def begin(handle: Handle) -> Future[Round] | None:
        """Let an idle worker continue if it has units, or gets some now."""
        order = scheduler.order(handle, time.monotonic())
        if not scheduler.workers[handle].units:
            return None
        return threads.submit(workers[handle].work, order, ROUND, stop.asked.is_set)

    with ThreadPoolExecutor(len(workers)) as threads:
        for handle in workers:
            scheduler.join(handle, time.monotonic())
        working: dict[Future[Round], Handle] = {}
        while not (scheduler.over or stop.asked.is_set()):
            scheduler.share()
            idle = [handle for handle in workers if handle not in working.values()]
            working |= {future: handle for handle in idle if (future := begin(handle))}
            board.refresh()
            for future in wait(working, POLL, FIRST_COMPLETED).done:
                report(working.pop(future), future.result())
        if stop.asked.is_set():
            board.say(STOPPING)
            for future, handle in working.items():
                report(handle, future.result())
            for handle, worker in workers.items():  # in this thread, where a second Ctrl-C interrupts it
                report(handle, worker.leave())


def _compile_side_by_side(ahead: "Ahead", threads: int, board: Board, stop: Stop) -> float:
    """Compile the programs that the cache lacks, in threads; return the seconds of all threads."""

    def compile_some() -> None:
        while not stop.asked.is_set() and ahead.compile_next():
            pass

    with ThreadPoolExecutor(threads) as pool:
        running = {pool.submit(compile_some) for _ in range(threads if ahead.left else 0)}
        while running:
            done, running = wait(running, POLL)
            board.tally.compiled = ahead.compiled
            board.refresh()
            for thread in done:
                thread.result()
    return ahead.compiling
