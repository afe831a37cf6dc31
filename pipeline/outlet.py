"""Standard streams of a command whose reader may close its end early, as `head` does, or whose disk may be full."""

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast


class Outlet:
    """A standard stream that discards output once its reader has closed it; stderr, after any error.

    The command then still finishes its work, and its exit code reports the result.
    """

    def __init__(self, stream: TextIO, ignored: type[OSError] = BrokenPipeError) -> None:
        self._stream, self._ignored = stream, ignored
        self.has_reader = True

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:  # a path that is not UTF-8, or a terminal that knows few characters
            encoding = self._stream.encoding
            return self.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except self._ignored:
            self._drop()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except self._ignored:
            self._drop()

    def _drop(self) -> None:
        """Redirect buffered and later output to the null device."""
        self.has_reader = False
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def outlets() -> Iterator[None]:
    """Wrap both standard streams in outlets for the `with` block, and flush them at its end.

    That flush ignores errors: the command itself flushes earlier, while it can still report them. A stream is None if
    the process started with its descriptor closed: the null device then takes its place, and in most processes its
    descriptor, which the next opened file would get otherwise.
    """
    with ExitStack() as stack:
        # Progress and messages may be lost, but not results
        both = (sys.stdout, redirect_stdout, BrokenPipeError), (sys.stderr, redirect_stderr, OSError)
        for stream, redirect, ignored in both:
            outlet = Outlet(stream or stack.enter_context(open(os.devnull, "w")), ignored)
            stack.callback(_flush, outlet)
            stack.enter_context(redirect(cast(TextIO, outlet)))
        yield


def _flush(outlet: Outlet) -> None:
    with suppress(OSError):
        outlet.flush()


def has_reader() -> bool:
    """Whether every write to standard output so far has found a reader."""
    return getattr(sys.stdout, "has_reader", True)
