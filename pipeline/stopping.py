"""Stopping a command on Ctrl-C or on SIGTERM, which batch systems send before they kill it: it can commit first."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from levelproof.pipeline.errors import Exit

GRACE = 20.0  # s after the first signal in which workers commit what they can
LAST = 28.0  # s from the first signal until this process ends itself; batch systems kill it after 30
HASTE = 5.0  # s from the second signal until it does: threads may be compiling, which nothing interrupts


class Stop:
    """A request to stop, made by signals.

    The first signal sets `asked` and, outside of a `heeded` block, raises KeyboardInterrupt, as every later signal
    does. `LAST` seconds after the first, or `HASTE` seconds after the second if that is sooner, a timer ends the
    process, because neither compiled code nor a hanging system call can be interrupted.
    """

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.clock = _clock(LAST)
        self._heeds = False
        self._asked_at = 0.0

    @property
    def grace(self) -> float:
        """Seconds left for workers to commit; valid once `asked` is set."""
        return self._asked_at + GRACE - time.monotonic()

    def listen(self) -> None:
        """Handle both signals, replacing any handler that a library has set since."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._signalled)

    @contextmanager
    def heeded(self) -> Iterator[None]:
        """Let the `with` block poll `asked` and end by itself; raise KeyboardInterrupt after it if `asked` is set."""
        self.listen()
        self._heeds = True
        try:
            yield
        finally:
            self._heeds = False
        if self.asked.is_set():
            raise KeyboardInterrupt

    def _signalled(self, *_: object) -> None:
        first = not self.asked.is_set()
        if first:
            self._asked_at = time.monotonic()
            self.clock.start()
            self.asked.set()
        elif self.clock.interval > HASTE and self._asked_at + LAST - time.monotonic() > HASTE:
            self.clock.cancel()
            self.clock = _clock(HASTE)
            self.clock.start()
        if not (first and self._heeds):
            raise KeyboardInterrupt


def _clock(seconds: float) -> threading.Timer:
    """Return a timer that ends this process."""
    clock = threading.Timer(seconds, os._exit, [Exit.INTERRUPTED])
    clock.daemon = True
    return clock


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Let SIGTERM and Ctrl-C stop the `with` block; works in the main thread only."""
    stop = Stop()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    stop.listen()
    try:
        yield stop
    finally:
        stop.clock.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)
