"""Runs of consecutive level ids, which describe any number of levels in one line."""

from collections.abc import Iterable, Sequence

import numpy as np

MAX_SHOWN = 4  # runs of levels in a message


def ascending(numbers: np.ndarray) -> np.ndarray:
    """Sort numbers and drop duplicates. `np.unique` hashes integers: for millions, it takes twenty times as long."""
    ordered = np.sort(numbers)
    return ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0]


def within(ordered: np.ndarray, first: int, last: int) -> np.ndarray:
    """Return those of these ascending ids that are from `first` to `last`."""
    low, high = np.searchsorted(ordered, [first, last + 1])
    return ordered[low:high]


def runs(numbers: Sequence[int] | np.ndarray) -> list[tuple[int, int]]:
    """Return first and last of each run of consecutive numbers, ascending."""
    if isinstance(numbers, range) and numbers.step == 1:  # needs no memory, whatever its length
        return [(numbers[0], numbers[-1])] if numbers else []
    ordered = ascending(np.asarray(numbers, np.int64))
    ends = np.flatnonzero(np.diff(ordered) != 1)
    firsts, lasts = (ordered[i] for i in (np.r_[0, ends + 1], np.r_[ends, -1])) if len(ordered) else (ordered, ordered)
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def inside(level_ids: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Whether each id lies in one of the runs (first and last id of each, ascending and apart)."""
    if not len(runs):
        return np.zeros(len(level_ids), bool)
    before = np.searchsorted(runs[:, 0], level_ids, side="right") - 1  # the last run that begins at or before an id
    return (before >= 0) & (level_ids <= runs[before, 1])


def without(runs: Iterable[Sequence[int]], level_ids: np.ndarray) -> list[tuple[int, int]]:
    """Remove ids (ascending) from runs; return the remaining runs."""
    left = []
    for first, last in runs:
        removed = within(level_ids, first, last)
        starts, ends = np.r_[first, removed + 1], np.r_[removed - 1, last]
        some = starts <= ends
        left += zip(starts[some].tolist(), ends[some].tolist(), strict=True)
    return left


def merged(*lists: Iterable[Sequence[int]]) -> list[tuple[int, int]]:
    """Merge lists of runs into ascending, disjoint runs."""
    together: list[tuple[int, int]] = []
    for first, last in sorted((first, last) for runs in lists for first, last in runs):
        if together and first <= together[-1][1] + 1:
            together[-1] = together[-1][0], max(together[-1][1], last)
        else:
            together.append((first, last))
    return together


def runs_text(runs: Sequence[Sequence[int]]) -> str:
    """Describe runs for a message: `levels 0 to 31, 96 to 127`."""
    parts = [f"{first} to {last}" if last > first else f"{first}" for first, last in runs]
    more = f" and {len(parts) - MAX_SHOWN} more runs of levels" if len(parts) > MAX_SHOWN else ""
    return f"level{'s' if len(parts) != 1 or runs[0][0] != runs[0][1] else ''} {', '.join(parts[:MAX_SHOWN])}{more}"
