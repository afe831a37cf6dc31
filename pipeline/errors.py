"""What can go wrong, as exit codes. Each message is one sentence: what is wrong, where, what to do."""

import re
from enum import IntEnum

from levelproof.configs.errors import readable


class Exit(IntEnum):
    """Exit codes of `levelproof`."""

    DONE = 0
    FAILED = 1
    INPUT = 2  # the user's input
    QUARANTINED = 3  # done, but for work units that failed repeatedly
    INTERRUPTED = 130  # Ctrl-C, as shells have it


class LevelproofError(Exception):
    """An error with a sentence for the user and an exit code."""

    exit_code = Exit.FAILED

    def __str__(self) -> str:
        """With URLs as they were typed: a Path makes `s3:/` of `s3://`."""
        return re.sub(r"\b(s3|gs|az|https?|hf):/(?=[^/])", r"\1://", readable(super().__str__()))


class UserError(LevelproofError):
    """Something in the command or its configuration has to change."""

    exit_code = Exit.INPUT


class Failure(LevelproofError):
    """The command was fine; the disk, the data or the machine was not."""


class StoreFailure(LevelproofError):
    """A store does not answer, or refuses. No `Failure`, which would say of what it stores that it is damaged."""
