"""How SIGTERM, a batch system's notice, and Ctrl-C end a command: with time to commit, and before it is killed."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from levelproof.pipeline.errors import Exit

GRACE = 20.0  # s from the first signal on, in which workers commit what they can
LAST = 28.0  # s from the first signal on, after which the process has ended; batch systems kill after 30


class Stop:
    """A request to stop. The first signal sets `asked` where the code heeds it, and else raises KeyboardInterrupt, as
    each later signal does. `LAST` seconds after the first the process ends, come what may: neither compiled code nor a
    system call that hangs can be interrupted."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.clock = threading.Timer(LAST, os._exit, [Exit.INTERRUPTED])
        self.clock.daemon = True
        self._heeds = False
        self._asked_at = 0.0

    @property
    def grace(self) -> float:
        """Seconds that workers have left to commit, once the stop is asked for."""
        return self._asked_at + GRACE - time.monotonic()

    def listen(self) -> None:
        """Handle both signals, also after a library has set a handler of its own."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._signalled)

    @contextmanager
    def heeded(self) -> Iterator[None]:
        """Let the `with` block end by itself once `asked` is set; KeyboardInterrupt follows it at the latest."""
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
        if not (first and self._heeds):
            raise KeyboardInterrupt


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Have SIGTERM and Ctrl-C stop the `with` block; in the main thread only."""
    stop = Stop()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    stop.listen()
    try:
        yield stop
    finally:
        stop.clock.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)
