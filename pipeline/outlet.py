"""Standard output and standard error of a command whose reader may leave before the end, as `head` does."""

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast


class Outlet:
    """A standard stream that drops what is written once its reader has left: the command finishes its work, and its
    exit code says what came of that."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.has_reader = True

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._drop()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop()

    def _drop(self) -> None:
        """Send what the stream still holds, and all that follows, to the null device."""
        self.has_reader = False
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def outlets() -> Iterator[None]:
    """Make both standard streams outlets in the `with` block, and flush them at its end, which reports no error: the
    command itself flushes where it can still report one."""
    with ExitStack() as stack:
        for stream, redirect in (sys.stdout, redirect_stdout), (sys.stderr, redirect_stderr):
            if stream is not None:  # as it is where the descriptor was closed
                outlet = Outlet(stream)
                stack.callback(_flushed, outlet)
                stack.enter_context(redirect(cast(TextIO, outlet)))
        yield


def _flushed(outlet: Outlet) -> None:
    with suppress(OSError):
        outlet.flush()


def has_reader() -> bool:
    """Whether the reader of standard output is still there, as far as writing to it has shown."""
    return getattr(sys.stdout, "has_reader", True)
