"""Errors and their exit codes. Each message is one sentence: what is wrong, where, what to do."""

import re
from enum import IntEnum
from typing import Any

from levelproof.configs.errors import readable


class Exit(IntEnum):
    """Exit codes of `levelproof`."""

    DONE = 0
    FAILED = 1
    INPUT = 2  # the user's input
    QUARANTINED = 3  # done, except for work units that failed repeatedly
    INTERRUPTED = 130  # Ctrl-C, as in shells: 128 + SIGINT


class LevelproofError(Exception):
    """Base of errors that have a sentence for the user and an exit code."""

    exit_code = Exit.FAILED

    def __reduce__(self) -> tuple[Any, ...]:
        return _with_message, (type(self), *self.args)  # some types build their messages from other arguments

    def __str__(self) -> str:
        """Return the message with URLs as typed: `Path` turns `s3://` into `s3:/`."""
        return re.sub(r"\b(s3|gs|az|https?|hf):/(?=[^/])", r"\1://", readable(super().__str__()))


def _with_message(kind: type[LevelproofError], *message: str) -> LevelproofError:
    error = kind.__new__(kind)
    error.args = message
    return error


class UserError(LevelproofError):
    """The command or its configuration must change."""

    exit_code = Exit.INPUT


class Failure(LevelproofError):
    """The command was valid, but the disk, the data or the machine failed."""


class StoreFailure(LevelproofError):
    """A store does not answer or rejects a request, or the cache has no room for what it sends.

    Not a `Failure`, which readers take for damaged data.
    """


def last_line(error: Exception) -> str:
    """Return the last line of a library's message, without its full stop; its type's name if it has no message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].rstrip(".")
