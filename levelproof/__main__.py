"""`python -m levelproof`: the command of the same name."""

import sys

from levelproof.pipeline.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
