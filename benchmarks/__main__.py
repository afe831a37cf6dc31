"""`python -m benchmarks NAME`."""

import sys

from benchmarks.race.command import main
from pipeline.errors import LevelproofError

if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except LevelproofError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
