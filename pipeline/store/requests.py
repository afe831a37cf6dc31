"""Requests to stores: how long they may take, which are repeated, and what is said of those that fail."""

import random
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from itertools import count
from pathlib import Path
from threading import BoundedSemaphore
from typing import Any, TypeVar

from levelproof.pipeline.errors import LevelproofError, StoreFailure, UserError
from levelproof.pipeline.urls import as_typed

REQUESTS = 16  # concurrent
SENDS = 2  # concurrent requests that send much; a link of 0.6 Mbit/s sends their parts within SENDING
MUCH = 2**18  # bytes of a request that waits for its turn to send; less is sent by REQUESTS requests within a minute
STREAMED = 2**20  # bytes of a response that are taken at once
RETRIES: dict[str, Any] = {
    "max_retries": 8,  # of a request that is throttled, refused, cut off or not answered; with jitter
    "retry_timeout": timedelta(seconds=60),
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=8), "base": 2},
}
TRIES = 3  # at least, however long each takes
# A slow link is not an error, but silence is: `timeout` limits a whole request, `read_timeout` the wait for its next
# bytes. Until the first of these, that wait includes the time that it takes to send the request
PATIENCE = {
    "connect_timeout": timedelta(seconds=5),
    "read_timeout": timedelta(seconds=60),
    "timeout": timedelta(hours=6),
    "allow_http": True,
}
# `read_timeout` of requests that send much; TRIES of them end before their worker counts as silent
SENDING = timedelta(minutes=5)
RESENDING = timedelta(minutes=5)  # their `retry_timeout`: obstore signs them once, and signatures expire
SIGN_IN = {
    "s3:": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket",
    "gs:": "set GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for a public bucket",
    "az:": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    "hf:": "set HF_TOKEN, or run `hf auth login`",
}
# Patterns in obstore's messages about failed requests:
STATUS = re.compile(r"status code: (\d{3}[A-Za-z ]*)")
PASSING = re.compile(r"status code: (408|409|429|50[02-4])")
NO_BUCKET = "NoSuchBucket"
CUT_OFF, SILENT = "response body error", "HTTP error"  # a response ends early; no response arrives
CLOUD = re.compile(r"latest/api/token|computeMetadata")  # endpoints where a cloud's machines get credentials

T = TypeVar("T")


class StoreSilent(StoreFailure):
    """A store does not answer, or no more bytes of its answer arrive."""


class Turns:
    """Limits the requests that a process makes at once. If one is never answered, those that wait for a turn fail, too.

    Each would otherwise be as patient as the first, one turn after another.
    """

    def __init__(self, most: int) -> None:
        self._free, self._failed = BoundedSemaphore(most), dict[Path, StoreSilent]()  # by host or bucket: the latest

    @contextmanager
    def turn(self, path: Path) -> Iterator[None]:
        """Wait for a turn, and hold it during the block, which makes a request and repeats it.

        Raises:
            StoreSilent: a request to the same host or bucket was given up meanwhile.
        """
        place = Path(*path.parts[:2])
        before = self._failed.get(place)
        with self._free:
            if (failed := self._failed.get(place)) and failed is not before:
                raise StoreSilent(*failed.args)
            try:
                yield
            except StoreSilent as silent:
                self._failed[place] = silent
                raise


RECEIVING, SENDING_MUCH = Turns(REQUESTS), Turns(SENDS)  # of this process


def obstore_module() -> Any:
    try:
        import obstore.exceptions
        import obstore.store
    except ImportError:
        raise UserError(
            'Reading splits that are not on this machine needs obstore: run `pip install -e ".[remote]"` in the clone.'
        ) from None
    return obstore


def data_of(answer: Any, most: float) -> bytes:
    """Read the bytes of a response; stop soon after `most`, so that the caller sees that it is too long."""
    data = bytearray()
    for part in answer.stream(min_chunk_size=STREAMED):
        data += part
        if len(data) > most:
            break
    return bytes(data)


def ask(path: Path, request: Callable[[], T], what: str = "read", turns: Turns | None = None) -> T:
    """Make a request, and retry it if the response is cut off or missing, in cases that obstore does not retry.

    obstore seldom retries cut-off responses, and never requests that it does not know to be idempotent. `turns` are
    RECEIVING or SENDING_MUCH for requests with much data; others, such as those that renew a lease, wait for none.

    Raises:
        FileNotFoundError: the store has no such file.
        UserError: it has no such bucket, or does not allow us to `what`.
        StoreFailure: it does not answer.
    """
    with turns.turn(path) if turns else nullcontext():
        return _repeated(path, request, what)


def _repeated(path: Path, request: Callable[[], T], what: str) -> T:
    exceptions, end = obstore_module().exceptions, time.monotonic() + RETRIES["retry_timeout"].total_seconds()
    for attempt in count():
        try:
            return request()
        except FileNotFoundError as error:
            if NO_BUCKET in str(error):
                raise _explained(path, str(error), what) from None
            raise FileNotFoundError(as_typed(path)) from None
        except exceptions.BaseError as error:
            text = str(error)
            passing = CUT_OFF in text or SILENT in text or PASSING.search(text)
            if not passing or CLOUD.search(text) or (attempt + 1 >= TRIES and time.monotonic() > end):
                raise _explained(path, text, what) from None
            time.sleep(random.uniform(0, min(0.1 * 2**attempt, 5)))
    raise AssertionError("unreachable")


def _explained(path: Path, text: str, what: str) -> LevelproofError:
    """Turn obstore's message about a failed request into a sentence."""
    url, how = as_typed(path), SIGN_IN.get(path.parts[0], "copy the split to a folder first")
    if NO_BUCKET in text:
        return UserError(f"There is no bucket {path.parts[1]!r}: check {url}.")
    if CLOUD.search(text):
        return UserError(f"There are no credentials to {what} {url}: {how}.")
    if "Range request not supported" in text:
        return StoreFailure(f"The server of {url} does not support range requests: copy the split to a folder first.")
    status = STATUS.search(text)
    reason = status[1].strip() if status else "it does not answer" if SILENT in text else text.splitlines()[0]
    if reason.startswith(("401", "403")):
        return UserError(f"The store does not let you {what} {url} ({reason}): {how}.")
    then = "run the same command again; what is committed stays" if what == "write" else "try again"
    kind = StoreSilent if SILENT in text or CUT_OFF in text else StoreFailure
    return kind(f"Cannot {what} {url} ({reason}): check the network and the URL, and {then}.")
