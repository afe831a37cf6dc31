"""Batches read ahead by threads, from any position on."""

import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from levelproof.pipeline.dataset.batch import Batch
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import own_cores

RENAMED = {"batch": "batch_size", "part": "subset"}  # in positions of the version before


class Batches(Iterator[Batch]):
    """Made by `Dataset.batches`. Its threads end with it: when it is used up, closed or forgotten."""

    def __init__(
        self, load: Callable[[int], Batch], count: int | None, of: Mapping[str, Any], prefetch: int, start: Any
    ) -> None:
        """Batch `position` is `load(position)`, for all below `count` (None: no end).

        `of` tells these batches from others, `prefetch` is how many are read before they are asked for, and `start` is
        None or what `state` gave.

        Raises:
            UserError: `start` is a position among other batches.
        """
        self._load, self._count, self._of = load, count, dict(of)
        self._position = 0 if start is None else _position_in(start, self._of)
        self._pool = ThreadPoolExecutor(len(own_cores()), "levelproof-reader")
        self._ahead: deque[Future[Batch]] = deque()
        self._most = max(prefetch, 0) + 1
        self._end = weakref.finalize(self, self._pool.shutdown, wait=False, cancel_futures=True)

    def __next__(self) -> Batch:
        while self._end.alive and len(self._ahead) < self._most and self._has(self._position + len(self._ahead)):
            self._ahead.append(self._pool.submit(self._load, self._position + len(self._ahead)))
        if not self._ahead:
            self.close()
            raise StopIteration
        try:
            batch = self._ahead.popleft().result()
        except BaseException:
            self.close()
            raise
        self._position += 1
        return batch

    def state(self) -> dict[str, Any]:
        """Where this is, as JSON has it: `batches(..., start=state)` goes on with the batch that would come next."""
        return {"position": self._position, "of": self._of}

    def close(self) -> None:
        """Stop reading ahead; there is no next batch then."""
        self._ahead.clear()
        self._end()

    def _has(self, position: int) -> bool:
        return self._count is None or position < self._count


def _position_in(start: Any, of: Mapping[str, Any]) -> int:
    try:
        position = start["position"]
        others = {RENAMED.get(name, name): value for name, value in dict(start["of"]).items()}
        differing = [name for name in of if others[name] != of[name]]
    except (KeyError, TypeError, ValueError):
        raise UserError("The start is no position of batches: give what their state() returned.") from None
    if differing or type(position) is not int or position < 0:
        told = ", ".join(f"{name} was {others[name]}, now {of[name]}" for name in differing)
        raise UserError(f"The start is a position among other batches ({told}): use the same settings.")
    return position
