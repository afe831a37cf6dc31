"""The command `levelproof` with rounds of hours, as with very many workers: `python -m tests.pipeline.long_rounds ...`.

It also has hours to stop.
"""

import sys

from levelproof.pipeline import stopping
from levelproof.pipeline.cli import main as cli
from levelproof.pipeline.jobs import cluster

HOURS = 1e4  # s

if __name__ == "__main__":
    cluster.until_report = lambda *_: HOURS
    stopping.GRACE = stopping.LAST = HOURS
    sys.exit(cli.main(sys.argv[1:]))
