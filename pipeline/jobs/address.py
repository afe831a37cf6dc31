"""The Ray cluster that RAY_ADDRESS names, and sentences on why Ray does not start. Knows nothing of Ray."""

import os
import re
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from levelproof.pipeline.errors import Failure, LevelproofError, UserError

CONNECT_SECONDS = 5.0  # s within which a cluster must accept a connection


def ray_address() -> str:
    """Return RAY_ADDRESS; empty if it is not set."""
    return os.environ.get("RAY_ADDRESS", "")


@contextmanager
def on_this_machine() -> Iterator[None]:
    """Ignore RAY_ADDRESS in the `with` block."""
    address = os.environ.pop("RAY_ADDRESS", None)
    try:
        yield
    finally:
        if address is not None:
            os.environ["RAY_ADDRESS"] = address


def require_reachable(address: str) -> None:
    """Check that a cluster accepts connections, because Ray itself would retry for minutes.

    Raises:
        UserError: no process listens at the address.
    """
    if match := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
        try:
            socket.create_connection((match[1].strip("[]"), int(match[2])), CONNECT_SECONDS).close()
        except (OSError, OverflowError, UnicodeError) as error:  # the last two: invalid port, invalid host name
            raise no_cluster(getattr(error, "strerror", None) or str(error)) from error


MISMATCH = "Version mismatch:"  # how Ray's error begins if a cluster has another Ray or Python


def no_cluster(reason: str) -> UserError:
    return UserError(
        f"There is no Ray cluster at RAY_ADDRESS={ray_address()} ({reason.rstrip('.')}): "
        "start one with `ray start --head`, correct the address, or unset it to use this machine."
    )


def cannot_start(error: Exception) -> LevelproofError | None:
    """Return the error for the user in place of that of `ray.init`; None if its cause is unknown."""
    reason = (str(error).strip().splitlines() or ["no message"])[0]
    if isinstance(error, ConnectionError):
        return no_cluster(reason)
    if isinstance(error, RuntimeError) and reason.startswith(MISMATCH):
        versions = " ".join(str(error).removeprefix(MISMATCH).split())
        return UserError(
            f"The cluster at RAY_ADDRESS={ray_address()} has another Ray or Python than this command ({versions}): "
            "install the same versions here, or start the cluster again from this environment."
        )
    if isinstance(error, TimeoutError) or type(error) is Exception:  # Ray's time-outs are of either type
        return Failure(
            f"Ray cannot start ({reason.rstrip('.')}): run the same command again when this machine is less busy, or "
            "with executor=inline."
        )
    if isinstance(error, OSError):
        return Failure(
            f"Ray cannot start ({error}): fix that, set RAY_TMPDIR to another folder, or use executor=inline."
        )
    return None


@contextmanager
def noticing_slow_starts(seconds: float) -> Iterator[None]:
    """Tell the user if the `with` block, in which Ray starts or connects, lasts longer: Ray has no time limit."""
    where = f"the cluster at RAY_ADDRESS={ray_address()}" if ray_address() else "Ray on this machine"
    words = f"Still waiting for {where} to answer: `ray status` shows its state; Ctrl-C stops waiting."
    notice = threading.Timer(seconds, print, (words,), {"file": sys.stderr, "flush": True})
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()
