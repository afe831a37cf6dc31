"""The executor without Ray: one worker in this process, for debugging."""

from pathlib import Path

from configs.schema import JobConfig
from pipeline.jobs.progress import Board
from pipeline.jobs.schedule import ROUND, Assignment, Settle, UnitQueue
from pipeline.runtime import interruptible, prepare_jax


def run(job: JobConfig, split: Path, queue: UnitQueue, settle: Settle, board: Board) -> None:
    """Work on the queue until it is empty."""
    prepare_jax()
    from pipeline.jobs.worker import Worker  # imports what reads the settings just made

    with interruptible():
        worker, assignment = Worker(job, split), Assignment()
        while True:
            while assignment.take(queue):
                pass
            if not assignment.units:
                return
            board.refresh()
            round = worker.work(assignment.units, ROUND)
            assignment.account(round)
            board.tally.running.update(round.totals)
            settle(round.outcomes)
