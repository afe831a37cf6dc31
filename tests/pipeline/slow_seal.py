"""A job without training whose seal hangs in a disk call: `python -m tests.pipeline.slow_seal OUT SECONDS BESIDE`.

The process ends at most SECONDS after it is asked to. If BESIDE is 1, the seal begins while workers run, and they run
until they are asked to stop; if it is 0, the seal begins after them.
"""

import sys
import threading
import time
from pathlib import Path

from rich.console import Console

from levelproof.configs.schema import JobConfig
from levelproof.experts.steps import EnvSteps
from levelproof.pipeline import stopping
from levelproof.pipeline.errors import Exit
from levelproof.pipeline.jobs import inline
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.progress import Board
from levelproof.pipeline.jobs.schedule import Round, Scheduler, Settle, Summary, UnitOutcome
from levelproof.pipeline.stopping import Stop
from levelproof.pipeline.store import merge, seal
from tests.pipeline.driver import LEVELS, UNIT, commit_made, job_of

HUNG = "the seal hangs"  # printed when it does


def hang(_: Path) -> None:
    print(HUNG, flush=True)
    threading.Event().wait()


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Commit units one after another, as workers do."""
    with stop.heeded():
        scheduler.join(run, time.monotonic())
        while not scheduler.over:
            outcomes = []
            for unit in scheduler.order(run, time.monotonic()).units:
                commit_made(split, unit)
                outcomes.append(UnitOutcome(unit, Summary(len(unit.level_ids), 0, EnvSteps())))
            scheduler.report(run, Round(outcomes, {}, 1), time.monotonic())
            settle(outcomes)
        while sys.argv[3] == "1" and not stop.asked.is_set():
            time.sleep(0.01)


if __name__ == "__main__":
    stopping.LAST = float(sys.argv[2])
    seal.ROWS = UNIT if sys.argv[3] == "1" else LEVELS
    merge.flush = hang
    inline.run = run  # type: ignore[assignment]
    job = job_of(sys.argv[1])
    try:
        generate(job, ["levelproof", "generate"], Console(stderr=True))
    except KeyboardInterrupt:
        sys.exit(Exit.INTERRUPTED)
