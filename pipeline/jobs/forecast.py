"""From some levels that were made to all of a job's: hours, bytes, files and solved levels, each with its interval.

Levels are independent of each other, so what some took says what more take: their mean, drawn again and again with
replacement, and the scatter of those that are yet to come.
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

DRAWS = 2000
LIKELY = 0.9  # of an interval
SHARDS_OWN, OTHERS = 1, 2  # zarr.json of a shard; job.json and manifest/index.txt of a split


class PerWitness(NamedTuple):
    """What a witness takes in one density."""

    bytes: float
    arrays: int  # of a shard


@dataclass(frozen=True)
class Sample:
    """What was measured of some levels."""

    device: str  # core or GPU
    workers: int
    wall: float  # s, of everything
    once: float  # s that a run takes whatever its number of levels: to start, to load programs, to wait for the last
    compiling: float  # s of a worker that finds nothing compiled
    busy: Float[np.ndarray, " level"]  # s of a worker, without compiling and idle slots
    solved: Bool[np.ndarray, " level"]
    witnessed: Bool[np.ndarray, " level"]
    row_bytes: float  # of the manifest
    stored: dict[str, PerWitness]  # by density


@dataclass(frozen=True)
class Guess:
    """A number that is not known yet: between `low` and `high` in nine of ten cases."""

    expected: float
    low: float
    high: float

    def told(self, scale: float = 1.0, tell: Callable[[float], str] = number) -> str:
        return "{} ({} to {})".format(*(tell(value / scale) for value in (self.expected, self.low, self.high)))


@dataclass(frozen=True)
class Forecast:
    """What a job would take. Hours of a core or GPU are those for which workers have it."""

    levels: int
    workers: int
    unit: int  # levels of a work unit
    unit_seconds: float  # s of a worker that it takes, lost when the worker dies
    wall: Guess  # s
    hours: Guess  # of all workers
    seconds_per_solved: Guess | None  # None: the sample has none
    solved: Guess
    bytes: dict[str, Guess]  # by density, the manifest with it
    files: dict[str, int]  # of the sealed split

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def forecast(sample: Sample, levels: int, workers: int, untimed: int, unit: int | None = None) -> Forecast:
    """What so many levels would take so many workers like those of the sample.

    `untimed` are levels of a work unit while nobody knows what a level takes; `unit` of any, if it is given.
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
    wall = _guess(seconds / workers + sample.once, busy / workers + sample.once)
    hours = Guess(*(value * workers / 3600 for value in (wall.expected, wall.low, wall.high)))
    any_solved = sample.solved.any()
    each = _guess(
        (seconds + workers * sample.once) / np.maximum(solved, 1.0),
        (busy + workers * sample.once) / max(sample.solved.mean() * levels, 1.0),
    )
    share = sample.witnessed.mean() * levels
    rows = levels * sample.row_bytes
    return Forecast(
        levels,
        workers,
        unit,
        float(unit * sample.busy.mean()),
        wall,
        hours,
        each if any_solved else None,
        _guess(solved, sample.solved.mean() * levels),
        {name: _guess(witnessed * of.bytes + rows, share * of.bytes + rows) for name, of in sample.stored.items()},
        {name: _files(levels, share, of) for name, of in sample.stored.items()},
    )


def _guess(draws: Float[np.ndarray, " draw"], expected: float) -> Guess:
    low, high = np.quantile(draws, [(1 - LIKELY) / 2, (1 + LIKELY) / 2])
    return Guess(float(expected), float(low), float(high))


def _files(levels: int, witnesses: float, of: PerWitness) -> int:
    """Of a split that is sealed."""
    fragments = math.ceil(levels / ROWS)
    rows = math.ceil(witnesses / fragments)  # of a shard
    rows_a_file = 1 << max(0, math.ceil(math.log2(FILE_BYTES / max(of.bytes, 1.0))))
    shard = SHARDS_OWN + of.arrays * (1 + math.ceil(rows / rows_a_file))
    return fragments * (1 + (shard if rows else 0)) + OTHERS
