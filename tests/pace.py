"""How slow this machine is, and how long a test waits on it before it fails.

Every limit in tests is written in seconds of a fast machine and passed through `patience`, which lengthens it by the
machine's slowness. LEVELPROOF_TEST_SLOWNESS=3 sets the slowness instead of measuring it: limits are then those of a
machine that takes three times as long.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np

SLOWNESS = "LEVELPROOF_TEST_SLOWNESS"
MAX_SLOWNESS = 20.0  # beyond this a hang would block the suite for hours
POLL = 0.02  # s between two checks of a condition

T = TypeVar("T")


def patience(seconds: float) -> float:
    """Lengthen a limit in seconds by this machine's slowness; never shorten it."""
    return seconds * slowness()


def slowness() -> float:
    """Return how many times as long as a fast machine this one takes, from 1 to MAX_SLOWNESS.

    The process that starts the tests measures it once; its children inherit the result (see `share`).
    """
    setting = os.environ.get(SLOWNESS)
    return min(max(float(setting) if setting else measured(), 1.0), MAX_SLOWNESS)


def share() -> None:
    """Measure the slowness, unless it is set, and pass it to all processes that this one starts."""
    os.environ[SLOWNESS] = f"{slowness():.3g}"


@cache
def measured() -> float:
    """Time small jobs by the wall clock, so that load from other processes counts; return the worst ratio."""
    return max(timed(job) / seconds for job, seconds in JOBS.items())


def timed(job: Callable[[], object]) -> float:
    """Return the wall-clock seconds that a job takes."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def compute() -> None:
    sum(number * number for number in range(1_000_000))
    matrix = np.ones((256, 256), np.float32)
    for _ in range(200):
        np.sin(matrix, out=matrix)


def start_process() -> None:
    subprocess.run([sys.executable, "-c", "import numpy"], check=True)


def write_files() -> None:
    with TemporaryDirectory() as folder:
        for number in range(20):
            with Path(folder, str(number)).open("wb") as file:
                file.write(bytes(4096))
                file.flush()
                os.fsync(file.fileno())


# Seconds that each job takes on a fast machine with nothing else to do. Files get more than a fast disk needs (5 ms
# each): only a disk that is slow enough to delay the tests should lengthen their limits.
JOBS = {compute: 0.15, start_process: 0.25, write_files: 0.1}


def wait_until(condition: Callable[[], T], seconds: float, failure: object = "") -> T:
    """Poll a condition until it holds, and return its value; raise AssertionError when `patience(seconds)` are over."""
    end = time.monotonic() + patience(seconds)
    while not (value := condition()):
        assert time.monotonic() < end, f"nothing happened within {patience(seconds):.0f} s: {failure}"
        time.sleep(POLL)
    return value
