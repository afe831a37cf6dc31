"""Write the random levels on which the reference publishes solve rates, for `evaluate --on reference-random`.

    python -m benchmarks.published [SIZE ...]

The reference samples them in its own environment, which is made on first use; that takes some minutes.
"""

import sys

from benchmarks import oracle
from benchmarks.oracle import alone, log
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.errors import LevelproofError
from levelproof.pipeline.learn.published import RANDOM_LEVELS, random_file


def main(sizes: list[str]) -> int:
    """Write the levels of these sizes that are missing; return the exit code."""
    try:
        for size in sizes or SIZES:
            write(size)
    except LevelproofError as error:
        log(f"Error: {error}")
        return error.exit_code
    return 0


def write(size: str) -> None:
    """Have the reference sample the levels of a size, unless they are there."""
    path = random_file(size)
    path.parent.mkdir(exist_ok=True)
    with alone(path.with_suffix(".lock")):
        if path.exists():
            return
        log(f"Sampling {RANDOM_LEVELS} levels of size {size} with the reference ...")
        unfinished = path.with_name(f"unfinished-{path.name}")
        arguments = [unfinished, "--size", size, "--count", RANDOM_LEVELS]
        oracle.run_script(oracle.oracle_python(), "published", arguments, "sample the reference's random levels")
        unfinished.replace(path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
