"""The Ray cluster that RAY_ADDRESS names. Knows nothing of Ray."""

import os
import re
import socket

from levelproof.pipeline.errors import UserError

REACH = 5.0  # s in which a cluster has to answer


def existing() -> str:
    """Its address; empty: none is named."""
    return os.environ.get("RAY_ADDRESS", "")


def require_reachable(address: str) -> None:
    """Ray itself tries for minutes.

    Raises:
        UserError: nobody listens there.
    """
    if found := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
        try:
            socket.create_connection((found[1].strip("[]"), int(found[2])), REACH).close()
        except (OSError, OverflowError, UnicodeError) as error:  # no such port, and what can be no host's name
            raise no_cluster(getattr(error, "strerror", None) or str(error)) from error


def no_cluster(reason: str) -> UserError:
    return UserError(
        f"There is no Ray cluster at RAY_ADDRESS={existing()} ({reason.rstrip('.')}): "
        "start one with `ray start --head`, correct the address, or unset it to use this machine."
    )
