"""The command `levelproof` with workers that die of a level: `python -m tests.pipeline.fragile LEVEL generate ...`."""

import os
import sys
import time

from pipeline import cli, cluster
from pipeline.schedule import Outcome, WorkUnit

MOMENT = 1.0  # s, in which the worker gets other units


class Fragile(cluster.Worker):
    """A worker as it is, but for one level that kills its process, as a fault in native code does."""

    deadly = int(sys.argv[1])

    def attempt(self, unit: WorkUnit) -> Outcome:
        if self.deadly in unit.level_ids:
            time.sleep(MOMENT)
            os._exit(1)
        return super().attempt(unit)


if __name__ == "__main__":
    cluster.Worker = Fragile  # type: ignore[misc]
    sys.exit(cli.main(sys.argv[2:]))
