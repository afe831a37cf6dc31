"""The command `levelproof` with rounds that last hours, as if it had very many workers, and as much time to stop.

Run it as `python -m tests.pipeline.long_rounds ...`.
"""

import sys

from levelproof.pipeline import stopping
from levelproof.pipeline.cli import main as cli
from levelproof.pipeline.jobs import cluster

if __name__ == "__main__":
    cluster.ROUND = stopping.GRACE = stopping.LAST = 1e4
    sys.exit(cli.main(sys.argv[1:]))
