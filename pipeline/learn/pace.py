"""Speed of a training run."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Pace:
    """Items per second since the first `count`, which leaves out reading and compiling."""

    def __init__(self) -> None:
        self._done: int | None = None  # items since the first count; None: not yet counted
        self._began = 0.0  # s

    def count(self, done: int) -> float:
        """Add finished items; return items per second since the first call, which returns 0."""
        now = time.monotonic()
        if self._done is None:
            self._done, self._began = 0, now
        else:
            self._done += done
        return self._done / max(now - self._began, 1e-9)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Exclude the time spent in the `with` block."""
        paused = time.monotonic()
        yield
        self._began += time.monotonic() - paused
