"""How many levels a work unit has: as many as keep a worker busy for about WORK seconds.

A unit's end costs the driver a report and the store some requests, so units must not be short; a unit's work is lost
when its worker dies, so they must not be long. Knows nothing of files, of Ray, or of the time.
"""

from collections import deque
from statistics import median

WORK = 40.0  # s of a worker in a unit; rounded to whole levels it is 20 to 60
UNITS_EACH = 4  # units that each worker gets at least, while the job has as many levels
MOST = 16  # times the levels of an untimed unit: a worker holds their records, 0.1 to 0.2 GB, several times over
RECENT = 31  # latest units, of which the median says what a level takes
STEP = 4  # times the levels of the largest of them: quick levels end first, and say too little of the others


def unit_levels(seconds: float | None, levels: int, workers: int, untimed: int) -> int:
    """Number of levels in a work unit. The scheduler and `levelproof plan` both ask here.

    Args:
        seconds: s of a worker that a level takes; None: no unit has ended yet.
        levels: of the job.
        workers: of the job.
        untimed: levels of a unit while nobody knows what a level takes.
    """
    wanted = untimed if seconds is None else round(min(WORK / max(seconds, WORK / (MOST * untimed)), MOST * untimed))
    return max(1, min(wanted, levels // (UNITS_EACH * max(workers, 1))))


class UnitSize:
    """Size of a job's next work unit, from what the levels of its latest units took."""

    def __init__(self, levels: int, untimed: int) -> None:
        """`levels` and `untimed` as in `unit_levels`."""
        self._levels, self._untimed = levels, untimed
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT)  # levels of a unit, s of each of them

    @property
    def seconds(self) -> float | None:
        """s of a worker that a level takes; None: no unit has ended yet."""
        return median(seconds for _, seconds in self._recent) if self._recent else None

    def note(self, levels: int, seconds: float, slowness: float | None) -> float | None:
        """Learn from a unit of so many levels that took its worker so long, s; return the worker's new `slowness`."""
        if not levels or seconds <= 0:
            return slowness
        self._recent.append((levels, seconds / levels))
        latest = seconds / levels / (self.seconds or 1.0)
        return latest if slowness is None else (slowness + latest) / 2

    def now(self, workers: int, slowness: float | None) -> int:
        """Number of levels in the next unit.

        Args:
            workers: of the job, now.
            slowness: of the worker that gets it: how many times as long as on others levels take there; None: it has
                ended no unit yet, so its first one is small, in case it is slow.
        """
        seconds = self.seconds
        if seconds is None:
            return unit_levels(None, self._levels, workers, self._untimed)
        most = STEP * max(levels for levels, _ in self._recent)
        if slowness is None:
            most, slowness = self._untimed, 1.0
        return min(most, unit_levels(seconds * slowness, self._levels, workers, self._untimed))
