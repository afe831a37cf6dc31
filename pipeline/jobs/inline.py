"""The executor without Ray: units one after another in this process, for debugging."""

from collections.abc import Callable, Sequence
from pathlib import Path

from configs.schema import JobConfig
from pipeline.jobs.progress import Board
from pipeline.jobs.schedule import Outcome, Queue
from pipeline.runtime import interruptible, prepare_jax


def run(job: JobConfig, split: Path, queue: Queue, settle: Callable[[Sequence[Outcome]], None], board: Board) -> None:
    """Work on the queue until it is empty."""
    prepare_jax()
    from pipeline.jobs.unit import attempt, pool_for  # imports what reads the settings just made

    with interruptible():
        while unit := queue.take():

            def report(env_steps: int, levels: float, solved: int, unit=unit) -> None:
                board.tally.progress(unit, env_steps, levels, solved)
                board.refresh()

            board.refresh()
            settle([attempt(job, split, unit, report, pool_for(job))])
