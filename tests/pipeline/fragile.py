"""The command `levelproof` with workers that die of a level: `python -m tests.pipeline.fragile LEVEL generate ...`.

Of level -1 they die before they have started.
"""

import os
import sys
from pathlib import Path

from configs.schema import JobConfig
from pipeline.cli import main as cli
from pipeline.jobs import cluster
from pipeline.jobs.schedule import Round, WorkUnit


class Fragile(cluster.WorkerActor):
    """A worker as it is, but for one level that kills its process, as a fault in native code does."""

    deadly = int(sys.argv[1])

    def __init__(self, job: JobConfig, split: Path, core: int | None) -> None:
        if self.deadly < 0:
            os._exit(1)
        super().__init__(job, split, core)

    def work(self, units: list[WorkUnit]) -> Round:
        if any(self.deadly in unit.level_ids for unit in units):
            os._exit(1)  # and with it die the units that it has from earlier rounds
        return super().work(units)


if __name__ == "__main__":
    cluster.WorkerActor = Fragile  # type: ignore[misc]
    sys.exit(cli.main(sys.argv[2:]))
