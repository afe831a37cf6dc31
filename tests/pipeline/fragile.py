"""The command `levelproof` with workers that die of a level: `python -m tests.pipeline.fragile LEVEL generate ...`.

Of level -1 they die before they have started.
"""

import os
import sys
import time
from pathlib import Path

from configs.schema import JobConfig
from pipeline.cli import main as cli
from pipeline.jobs import cluster
from pipeline.jobs.schedule import Outcome, WorkUnit

MOMENT = 1.0  # s, in which the worker gets other units


class Fragile(cluster.Worker):
    """A worker as it is, but for one level that kills its process, as a fault in native code does."""

    deadly = int(sys.argv[1])

    def __init__(self, job: JobConfig, split: Path, core: int | None) -> None:
        if self.deadly < 0:
            os._exit(1)
        super().__init__(job, split, core)

    def attempt(self, unit: WorkUnit) -> Outcome:
        if self.deadly in unit.level_ids:
            time.sleep(MOMENT)
            os._exit(1)
        return super().attempt(unit)


if __name__ == "__main__":
    cluster.Worker = Fragile  # type: ignore[misc]
    sys.exit(cli.main(sys.argv[2:]))
