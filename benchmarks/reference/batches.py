# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks reader`: its own trajectory manager on an exported folder.

The manager reads up to 500 batches ahead. While the rate is measured, the caller takes batches as fast as they come, so
that the queue stays empty, the rate is sustainable, and memory stays small.
"""

import argparse
import json
import os
import pickle
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

KEPT, ROUNDS = 4, 3  # batches that are copied, and how often; also those whose states are kept


def rates(
    next_batch: Callable[[], Any], arrays: Callable[[Any], list], batch: int, seconds: float
) -> tuple[dict[str, float], list[Any]]:
    """Measure trajectories/s and, as `core_...`, per second of CPU time: as read, and with every array copied.

    Also returns the batches that were copied.

    Copies are timed by the CPU time of their own thread, and few: a caller that copies is slower than the readers,
    which then fill the memory with batches that nobody takes.
    """

    def read() -> tuple[float, float]:
        start, cpu_start, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - start < seconds:
            next_batch()
            count += batch
        return (time.perf_counter() - start) / count, (time.process_time() - cpu_start) / count

    read()  # warms up, and empties the queue
    reading, of_core = read()
    kept = [next_batch() for _ in range(KEPT)]
    some = [array for each in kept for array in arrays(each)]
    before = time.thread_time()
    for array in some * ROUNDS:
        np.ascontiguousarray(array)
    copying = (time.thread_time() - before) / (KEPT * ROUNDS * batch)
    names = ("rate", "core_rate", "copied", "core_copied")
    times = (reading, of_core, reading + copying, of_core + copying)
    return {name: 1 / taken for name, taken in zip(names, times, strict=True)}, kept


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--batch", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--keep", type=Path, help="file for the states of some batches")
    args = parser.parse_args()

    import jax
    from kinetix.data import TrajectoryDatasetManager

    start = time.perf_counter()
    manager = TrajectoryDatasetManager(args.folder, args.batch, seed=0)
    manager.load_next_batch()
    first = time.perf_counter() - start
    found, kept = rates(manager.load_next_batch, jax.tree.leaves, args.batch, args.seconds)
    print(json.dumps({"first": first} | found), flush=True)
    if args.keep:
        with args.keep.open("wb") as file:
            for batch in kept:
                pickle.dump(batch.env_state, file, protocol=5)


if __name__ == "__main__":
    code = 1
    try:
        main()
        code = 0
    except Exception:
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)  # a usual end would wait for the reading threads, which fill the memory with batches
