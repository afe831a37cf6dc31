"""How fast a run goes on."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Pace:
    """What is done per second, from the first count on: reading and compiling come before it, and do not count."""

    def __init__(self) -> None:
        self._done: int | None = None  # since the first count; None: there was none
        self._began = 0.0  # s

    def count(self, done: int) -> float:
        """Count what has just been done. Return what is done per second since the first count; at that, 0."""
        now = time.monotonic()
        if self._done is None:
            self._done, self._began = 0, now
        else:
            self._done += done
        return self._done / max(now - self._began, 1e-9)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Leave out the time that passes within."""
        paused = time.monotonic()
        yield
        self._began += time.monotonic() - paused
