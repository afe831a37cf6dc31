"""The executor without Ray: one worker in this process."""

import time
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.jobs.progress import STOPPING, Board
from levelproof.pipeline.jobs.schedule import ROUND, Scheduler, Settle
from levelproof.pipeline.runtime import NO_GPU, jax_sees_a_gpu, own_cores, prepare_jax
from levelproof.pipeline.stopping import Stop

if TYPE_CHECKING:
    from levelproof.pipeline.jobs.ahead import Ahead

HERE = "this process"
POLL = 0.25  # s between progress updates while programs compile
MAX_THREADS = 6  # threads that compile; one at a time traces, which takes a fifth of the time
MANY = 16  # levels; a job of fewer may compile programs that it does not use


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Run all units in this process, or until a stop is requested."""
    prepare_jax(device=job.device)
    if job.device == "gpu" and not jax_sees_a_gpu():
        board.say(f"This process uses a CPU core, not a GPU: {NO_GPU}.")
    # These modules read JAX's settings on import, so import them after JAX is set up
    from levelproof.pipeline.jobs.ahead import Ahead
    from levelproof.pipeline.jobs.workers import worker_for

    with stop.heeded():
        worker = worker_for(job, split)
        threads = min(len(own_cores()), MAX_THREADS)
        if worker.pool and job.device == "cpu" and threads > 1 and scheduler.waiting >= MANY:
            worker.compiling = _compile_side_by_side(Ahead(job, worker.pool), threads, board, stop)
            if stop.asked.is_set():
                return  # no level has begun
        scheduler.join(HERE, time.monotonic())
        while not scheduler.over:
            if stop.asked.is_set():
                board.say(STOPPING)
                worker.stopping = True
            order = scheduler.order(HERE, time.monotonic())
            board.refresh()
            round = worker.work(order, ROUND, stop.asked.is_set)
            scheduler.report(HERE, round, time.monotonic())
            board.tally.follow(round)
            settle(round.outcomes)
            if round.leaves:
                raise KeyboardInterrupt


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
