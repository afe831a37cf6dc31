"""Our side of `python -m benchmarks reader`: random batches of a split, with every field."""

import argparse
import json
import time

import jax
import numpy as np

import levelproof
from benchmarks.reference.batches import rates


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("split")
    parser.add_argument("--batch", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    args = parser.parse_args()
    start = time.perf_counter()
    data = levelproof.open(args.split)
    batches = data.batches(args.batch, seed=0, fields=["record", "level"], observation=None, epochs=None)
    next_batch = lambda: next(batches)
    next_batch()
    first = time.perf_counter() - start
    arrays = lambda batch: [x for x in jax.tree.leaves(batch) if isinstance(x, np.ndarray)]
    print(json.dumps({"first": first} | rates(next_batch, arrays, args.batch, args.seconds)[0]))


if __name__ == "__main__":
    main()
