"""Resumable iteration over batches, which threads prefetch."""

import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from levelproof.pipeline.dataset.batch import Batch
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import own_cores

RENAMED = {"batch": "batch_size", "part": "subset"}  # old names in states saved by the previous version


class Batches(Iterator[Batch]):
    """Iterator over batches, from `Dataset.batches`. Its threads stop when it is exhausted, closed or collected."""

    def __init__(
        self, load: Callable[[int], Batch], count: int | None, settings: Mapping[str, Any], prefetch: int, start: Any
    ) -> None:
        """Start iterating, and prefetching.

        Args:
            load: returns the batch at a position; called in threads.
            count: number of batches; None: endless.
            settings: arguments that determine the sequence of batches, as JSON.
            prefetch: number of batches to read ahead.
            start: a result of `state` to resume from; None: the first batch.

        Raises:
            UserError: `start` is invalid, or was saved with other settings.
        """
        self._load, self._count, self._settings = load, count, dict(settings)
        self._position = 0 if start is None else _position_in(start, self._settings)
        self._pool = ThreadPoolExecutor(len(own_cores()), "levelproof-reader")
        self._ahead: deque[Future[Batch]] = deque()
        self._max_ahead = max(prefetch, 0) + 1
        self._end = weakref.finalize(self, self._pool.shutdown, wait=False, cancel_futures=True)

    def __next__(self) -> Batch:
        while self._end.alive and len(self._ahead) < self._max_ahead and self._has(self._position + len(self._ahead)):
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
        """Return the position as JSON values: `batches(..., start=state)` resumes with the batch that would be next."""
        return {"position": self._position, "of": self._settings}

    def close(self) -> None:
        """Stop prefetching and end the iteration."""
        self._ahead.clear()
        self._end()

    def _has(self, position: int) -> bool:
        return self._count is None or position < self._count


def _position_in(start: Any, settings: Mapping[str, Any]) -> int:
    try:
        position = start["position"]
        saved = {RENAMED.get(name, name): value for name, value in dict(start["of"]).items()}
        differing = [name for name in settings if saved[name] != settings[name]]
    except (KeyError, TypeError, ValueError):
        raise UserError("The start is not a state of batches: pass what their state() returned.") from None
    if differing or type(position) is not int or position < 0:
        changes = ", ".join(f"{name} was {saved[name]}, now {settings[name]}" for name in differing)
        raise UserError(f"The start was saved with other settings ({changes}): use the same ones.")
    return position
