"""Forecast of a job's hours, bytes, files and solved levels from a sample of its levels, each with its interval.

Levels are independent, so a total over N levels has two sources of uncertainty: the sample's mean, which bootstrap
resampling estimates, and the scatter of the N levels themselves, with a standard deviation of sqrt(N) times a level's.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from levelproof.pipeline.jobs.sizing import unit_levels
from levelproof.pipeline.store.merge import FILE_BYTES
from levelproof.pipeline.store.seal import ROWS
from levelproof.pipeline.words import number

DRAWS = 2000  # bootstrap resamples
LIKELY = 0.9  # coverage of an interval
FILES_OF_SHARD, FILES_OF_SPLIT = 1, 2  # zarr.json; job.json and manifest/index.txt


class PerWitness(NamedTuple):
    """Stored size of a witness in one density."""

    bytes: float
    arrays: int  # number of arrays in a shard


@dataclass(frozen=True)
class Sample:
    """Measurements of a job's first levels, from which the rest is estimated."""

    device: str  # core or GPU
    workers: int
    wall: float  # s, of the whole measurement
    once: float  # s that every run spends, however short: starting, loading programs, waiting for the last levels
    compiling: float  # s of a worker with an empty cache
    busy: Float[np.ndarray, " level"]  # s of a worker, without compiling and idle slots
    solved: Bool[np.ndarray, " level"]
    witnessed: Bool[np.ndarray, " level"]
    row_bytes: float  # bytes of a manifest row
    stored: dict[str, PerWitness]  # by density
    expert_bytes: float = 0.0  # bytes of kept experts, per level


@dataclass(frozen=True)
class Estimate:
    """A number with its 90 % interval, from `low` to `high`."""

    expected: float
    low: float
    high: float

    def text(self, scale: float = 1.0, form: Callable[[float], str] = number) -> str:
        """Format the number and its interval, in units of `scale`."""
        return "{} ({} to {})".format(*(form(value / scale) for value in (self.expected, self.low, self.high)))


@dataclass(frozen=True)
class Forecast:
    """Estimated cost of a job. A core or GPU counts for as long as a worker holds it, busy or not."""

    levels: int
    workers: int
    unit: int  # levels of a work unit
    unit_seconds: float  # s of a worker per unit, lost when the worker dies
    wall: Estimate  # s
    hours: Estimate  # of all workers
    seconds_per_solved: Estimate | None  # None: the sample has no solved level
    solved: Estimate
    bytes: dict[str, Estimate]  # by density, including the manifest
    files: dict[str, int]  # by density, of the sealed split

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def forecast(sample: Sample, levels: int, workers: int, untimed: int, unit: int | None = None) -> Forecast:
    """Estimate the cost of a job on workers like those of the sample.

    Args:
        levels: number of levels.
        workers: number of workers.
        untimed: number of levels in a work unit before the first one has ended.
        unit: number of levels in every work unit; None: units are timed.
    """
    rng = np.random.default_rng(0)
    count = len(sample.busy)
    drawn = rng.integers(count, size=(DRAWS, count))

    def total(values: Float[np.ndarray, " level"]) -> Float[np.ndarray, " draw"]:
        scatter = values.std() * math.sqrt(levels) * rng.standard_normal(DRAWS)
        return np.maximum(values[drawn].mean(1) * levels + scatter, 0.0)

    solved = np.clip(total(sample.solved.astype(float)), 0, levels)
    witnessed = np.clip(total(sample.witnessed.astype(float)), 0, levels)
    seconds, busy = total(sample.busy), sample.busy.mean() * levels
    unit = unit or unit_levels(sample.busy.mean(), levels, workers, untimed)
    wall = _estimate(seconds / workers + sample.once, busy / workers + sample.once)
    hours = Estimate(*(value * workers / 3600 for value in (wall.expected, wall.low, wall.high)))
    any_solved = sample.solved.any()
    each = _estimate(
        (seconds + workers * sample.once) / np.maximum(solved, 1.0),
        (busy + workers * sample.once) / max(sample.solved.mean() * levels, 1.0),
    )
    witnesses = sample.witnessed.mean() * levels
    rows = levels * (sample.row_bytes + sample.expert_bytes)
    archives = math.ceil(levels / unit) if sample.expert_bytes else 0
    return Forecast(
        levels,
        workers,
        unit,
        float(unit * sample.busy.mean()),
        wall,
        hours,
        each if any_solved else None,
        _estimate(solved, sample.solved.mean() * levels),
        {
            density: _estimate(witnessed * size.bytes + rows, witnesses * size.bytes + rows)
            for density, size in sample.stored.items()
        },
        {density: _files(levels, witnesses, size) + archives for density, size in sample.stored.items()},
    )


def _estimate(draws: Float[np.ndarray, " draw"], expected: float) -> Estimate:
    low, high = np.quantile(draws, [(1 - LIKELY) / 2, (1 + LIKELY) / 2])
    return Estimate(float(expected), float(low), float(high))


def _files(levels: int, witnesses: float, size: PerWitness) -> int:
    """Return the number of files in the sealed split."""
    fragments = math.ceil(levels / ROWS)
    rows = math.ceil(witnesses / fragments)  # of a shard
    rows_a_file = 1 << max(0, math.ceil(math.log2(FILE_BYTES / max(size.bytes, 1.0))))
    shard = FILES_OF_SHARD + size.arrays * (1 + math.ceil(rows / rows_a_file))
    return fragments * (1 + (shard if rows else 0)) + FILES_OF_SPLIT
