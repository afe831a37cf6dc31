# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks reader`: its own trajectory manager on an exported folder.

The manager reads up to 500 batches ahead. Here the caller takes batches as fast as they come, so that the queue stays
empty, the rate is sustainable, and memory stays small.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

WARM = 24  # batches before the clock starts


def rates(next_batch: Callable[[], Any], arrays: Callable[[Any], list], batch: int, seconds: float) -> dict[str, float]:
    """Measure trajectories/s and, as `core_...`, per second of CPU time: as read, and with every array copied."""

    def rate(use: Callable[[Any], object]) -> tuple[float, float]:
        start, cpu_start, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - start < seconds:
            use(next_batch())
            count += batch
        return count / (time.perf_counter() - start), count / (time.process_time() - cpu_start)

    (plain, of_core), (copied, copied_of_core) = (
        rate(use) for use in (lambda x: x, lambda x: [np.ascontiguousarray(array) for array in arrays(x)])
    )
    return {"rate": plain, "core_rate": of_core, "copied": copied, "core_copied": copied_of_core}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--batch", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    args = parser.parse_args()

    import jax
    from kinetix.data import TrajectoryDatasetManager

    start = time.perf_counter()
    manager = TrajectoryDatasetManager(args.folder, args.batch, seed=0)
    manager.load_next_batch()
    first = time.perf_counter() - start
    for _ in range(WARM):
        manager.load_next_batch()
    print(json.dumps({"first": first} | rates(manager.load_next_batch, jax.tree.leaves, args.batch, args.seconds)))


if __name__ == "__main__":
    main()
