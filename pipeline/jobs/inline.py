"""The executor without Ray: one worker in this process, for debugging."""

import time
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.jobs.progress import STOPPING, Board
from levelproof.pipeline.jobs.schedule import ROUND, Scheduler, Settle
from levelproof.pipeline.runtime import NO_GPU, jax_sees_a_gpu, prepare_jax
from levelproof.pipeline.stopping import Stop

HERE = "this process"


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Run all units in this process, or until `stop` is asked for."""
    prepare_jax(device=job.device)
    if job.device == "gpu" and not jax_sees_a_gpu():
        board.say(f"This process uses a CPU core, not a GPU: {NO_GPU}.")
    from levelproof.pipeline.jobs.worker import Worker  # its imports read JAX's settings, so they come after them

    with stop.heeded():
        worker = Worker(job, split)
        scheduler.join(HERE, time.monotonic())
        while not scheduler.over:
            if stop.asked.is_set():
                board.say(STOPPING)
                worker.stopping = True
            order = scheduler.order(HERE, time.monotonic())
            board.refresh()
            round = worker.work(order, ROUND)
            scheduler.report(HERE, round, time.monotonic())
            board.tally.follow(round)
            settle(round.outcomes)
            if round.leaves:
                raise KeyboardInterrupt
