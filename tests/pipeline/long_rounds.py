"""The command `levelproof` with rounds of ten minutes, as if it had tens of thousands of workers.

Run it as `python -m tests.pipeline.long_rounds ...`.
"""

import sys

from levelproof.pipeline.cli import main as cli
from levelproof.pipeline.jobs import cluster

if __name__ == "__main__":
    cluster.ROUND = 600.0
    sys.exit(cli.main(sys.argv[1:]))
