"""Our side of `python -m benchmarks sampler`: seconds of the first call, and the rate afterwards."""

import argparse
import json

import jax
import numpy as np

from benchmarks.reference.serve import timed
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels

FIRST = 256  # levels of the first call: one block


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", required=True)
    parser.add_argument("--levels", type=int, required=True)
    args = parser.parse_args()
    sample = lambda count: jax.block_until_ready(sample_levels(np.arange(count), SIZES[args.size]))
    first, _ = timed(lambda: sample(FIRST))
    seconds, _ = timed(lambda: sample(args.levels))
    print(json.dumps({"first": first, "rate": args.levels / seconds}))


if __name__ == "__main__":
    main()
