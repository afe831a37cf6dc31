"""Statistics of the reference's random levels, for tests/levelgen/test_sampler.py.

This script runs inside the reference's own environment, with what benchmarks/reference has for it:

    python -m venv REF && REF/bin/pip install kinetix-env==3.0.2 "jax[cpu]"
    PYTHONPATH=benchmarks/reference REF/bin/python tests/golden/make_level_statistics.py \
        tests/golden/level_statistics.npz

It samples levels and writes, for each size and statistic of level_statistics.py, either the values and how often
each occurs, or QUANTILES + 1 quantiles and the number of values. `--levels FILE` also keeps the levels themselves
as FILE with {size} in its name replaced.
"""

import argparse
import json
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
from level_statistics import statistics
from world import flatten, sampler

QUANTILES = 256
COUNTED = 40  # statistics with at most so many different values are kept as counts
COUNTS = {"s": 20000, "m": 20000, "l": 8000}  # levels
BATCH = 1000


def sample(size, count, seed):
    draw, parts = sampler(size), []
    for start in range(0, count, BATCH):
        key = jax.random.fold_in(jax.random.PRNGKey(seed), start)
        parts.append(flatten(draw(jax.random.split(key, BATCH))))
    return {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}


def summary(values):
    """Counts or quantiles of a sample."""
    values = np.asarray(values, np.float64)
    different, counts = np.unique(values, return_counts=True)
    if len(different) <= COUNTED:
        return {"values": different.astype(np.float32), "counts": counts.astype(np.int32)}
    quantiles = np.quantile(values, np.linspace(0, 1, QUANTILES + 1)).astype(np.float32)
    if len(np.unique(quantiles)) != len(quantiles):
        raise ValueError("a statistic with many values has a frequent one: quantiles do not describe it")
    return {"quantiles": quantiles, "counts": np.array([len(values)], np.int32)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--sizes", nargs="+", default=list(COUNTS))
    parser.add_argument("--seed", type=int, default=4242)
    parser.add_argument("--levels", default="", help="keep the levels, as in --levels levels_{size}.npz")
    given = parser.parse_args()
    arrays, about = {}, {"seed": given.seed, "levels": {size: COUNTS[size] for size in given.sizes}}
    about["versions"] = {name: version(name) for name in ("kinetix-env", "jax2d", "jax", "numpy")}
    for size in given.sizes:
        fields = sample(size, COUNTS[size], given.seed)
        if given.levels:
            np.savez_compressed(given.levels.format(size=size), **fields)
        for name, values in statistics(fields).items():
            arrays |= {f"{size}/{name}/{part}": array for part, array in summary(values).items() if len(values)}
        print(f"{size}: {COUNTS[size]} levels", flush=True)
    np.savez_compressed(given.out, about=json.dumps(about), **arrays)


if __name__ == "__main__":
    main()
