"""The command `levelproof` with workers that one level kills: `python -m tests.pipeline.fragile LEVEL SECONDS ...`.

If LEVEL is -1, they die before they have started. The driver gives up a worker after SECONDS without a report.
"""

import os
import sys
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.cli import main as cli
from levelproof.pipeline.jobs import cluster
from levelproof.pipeline.jobs.likeness import Versions
from levelproof.pipeline.jobs.schedule import Order, Round


class Fragile(cluster.WorkerActor):
    """A real worker, except that one level kills its process, as a fault in native code does."""

    deadly = int(sys.argv[1])

    def begin(self, versions: Versions, job: JobConfig, split: Path, neighbours: int, writer: str) -> str:
        if self.deadly < 0:
            os._exit(1)
        return super().begin(versions, job, split, neighbours, writer)

    def work(self, order: Order, seconds: float) -> Round:
        if any(self.deadly in unit.level_ids for unit in order.units):
            os._exit(1)  # also takes its units from earlier rounds
        return super().work(order, seconds)


if __name__ == "__main__":
    cluster.MAX_SILENT = float(sys.argv[2])
    cluster.WorkerActor = Fragile  # type: ignore[misc]
    sys.exit(cli.main(sys.argv[3:]))
