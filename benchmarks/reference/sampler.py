# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks sampler`: seconds of the first call, and the rate afterwards."""

import argparse
import json

from serve import timed
from world import BATCH, keys_of, sampler

FEW = 2  # batches of m and l, where the sampler is slow


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", required=True)
    parser.add_argument("--levels", type=int, required=True)
    args = parser.parse_args()

    import jax

    sample, keys = sampler(args.size), keys_of(0, args.levels)
    first, _ = timed(lambda: jax.block_until_ready(sample(keys[0])))
    keys = keys if args.size == "s" else keys[:FEW]
    seconds, _ = timed(lambda: [jax.block_until_ready(sample(batch)) for batch in keys])
    print(json.dumps({"first": first, "rate": len(keys) * BATCH / seconds}))


if __name__ == "__main__":
    main()
