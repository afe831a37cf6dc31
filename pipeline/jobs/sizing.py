"""Number of levels in a work unit: as many as keep a worker busy for about WORK seconds.

Each unit costs the driver a report and the store some requests, so units must not be short; a unit's work is lost if
its worker dies, so they must not be long. Knows nothing of files, Ray, or the time.
"""

from collections import deque
from statistics import median

WORK = 40.0  # s of a worker per unit; 20 to 60 after rounding to whole levels
UNITS_EACH = 4  # minimum number of units per worker, if the job has enough levels
MAX_FACTOR = 16  # maximum size of a unit, in untimed units: a worker holds several copies of its records (0.1-0.2 GB)
RECENT = 31  # latest units, whose median gives the time of a level
STEP = 4  # maximum growth over the largest recent unit: the first units to end have untypically quick levels


def unit_levels(seconds: float | None, levels: int, workers: int, untimed: int) -> int:
    """Return the number of levels in a work unit, for the scheduler and `levelproof plan`.

    Args:
        seconds: s of a worker per level; None: no unit has ended yet.
        levels: number of levels in the job.
        workers: number of workers of the job.
        untimed: number of levels in a unit before the first one has ended.
    """
    most = MAX_FACTOR * untimed
    wanted = untimed if seconds is None else round(min(WORK / max(seconds, WORK / most), most))
    return max(1, min(wanted, levels // (UNITS_EACH * max(workers, 1))))


class UnitSize:
    """Size of a job's next work unit, from the time that its latest units took."""

    def __init__(self, levels: int, untimed: int) -> None:
        """`levels` and `untimed` as in `unit_levels`."""
        self._levels, self._untimed = levels, untimed
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT)  # levels of a unit, s per level

    @property
    def seconds(self) -> float | None:
        """Seconds of a worker per level; None: no unit has ended yet."""
        return median(seconds for _, seconds in self._recent) if self._recent else None

    def note(self, levels: int, seconds: float, slowness: float | None) -> float | None:
        """Record a unit's number of levels and its worker's time, s; return the worker's new `slowness`."""
        if not levels or seconds <= 0:
            return slowness
        self._recent.append((levels, seconds / levels))
        latest = seconds / levels / (self.seconds or 1.0)
        return latest if slowness is None else (slowness + latest) / 2

    def now(self, workers: int, slowness: float | None) -> int:
        """Return the number of levels in the next unit.

        Args:
            workers: current number of workers.
            slowness: time per level of the worker that gets the unit, divided by other workers'; None: it has ended
                no unit yet, so its first one is small, in case the worker is slow.
        """
        seconds = self.seconds
        if seconds is None:
            return unit_levels(None, self._levels, workers, self._untimed)
        most = STEP * max(levels for levels, _ in self._recent)
        if slowness is None:
            most, slowness = self._untimed, 1.0
        return min(most, unit_levels(seconds * slowness, self._levels, workers, self._untimed))
