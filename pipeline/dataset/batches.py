"""Resumable iteration over batches, which threads prefetch."""

import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

from levelproof.pipeline.dataset.order import EpochOrder
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import own_cores

FINISHED = 2  # maximum number of batches finished ahead of the caller: the next and the one after
T = TypeVar("T")


class Batches(Iterator[T], Generic[T]):
    """Iterator over batches, from `Dataset.batches` and `Dataset.episode_batches`.

    Its threads stop when it is exhausted, closed or collected.
    """

    def __init__(
        self,
        load: Callable[[range], Sequence[Any]],
        count: int | None,
        settings: Mapping[str, Any],
        prefetch: int,
        start: Any,
        together: int = 1,
        finish: Callable[[Any], T] | None = None,
    ) -> None:
        """Start iterating, and prefetching.

        Args:
            load: returns what makes the batches at consecutive positions; called in threads. The last positions may
                be beyond `count`.
            count: number of batches; None: endless.
            settings: arguments that determine the sequence of batches, as JSON.
            prefetch: number of batches to read ahead.
            start: a result of `state` to resume from; None: the first batch.
            together: number of batches that one call of `load` is for.
            finish: makes each batch, shortly before it is returned, so that those ahead may be smaller; called in a
                thread; None: `load` returns batches.

        Raises:
            UserError: `start` is invalid, or was saved with other settings.
        """
        self._load, self._finish, self._count, self._settings = load, finish, count, dict(settings)
        self._position = 0 if start is None else _position_in(start, self._settings)
        self._pool = ThreadPoolExecutor(len(own_cores()), "levelproof-reader")
        self._finisher = ThreadPoolExecutor(1, "levelproof-reader")  # in the other pool it would wait behind loads
        self._together, self._next = together, self._position  # the position that is loaded next
        self._ahead: deque[tuple[range, Future[Sequence[Any]]]] = deque()
        self._loaded: deque[Any] = deque()
        self._finished: deque[Future[T]] = deque()
        self._most = max(prefetch + 1, together)  # the batch that is returned next, and those ahead of it
        self._end = weakref.finalize(self, _stop, self._pool, self._finisher)

    def __next__(self) -> T:
        while self._end.alive and self._has_room() and (some := self._positions()):
            self._ahead.append((some, self._pool.submit(self._load, self._padded(some))))
            self._next = some.stop
        try:
            while len(self._finished) < FINISHED and self._has_loaded():
                self._finished.append(self._finishing(self._loaded.popleft()))
            if self._finished:
                batch = self._finished.popleft().result()
                self._position += 1
                return batch
        except BaseException:
            self.close()
            raise
        self.close()
        raise StopIteration

    def _finishing(self, loaded: Any) -> Future[T]:
        if self._finish is not None:
            return self._finisher.submit(self._finish, loaded)
        finished: Future[T] = Future()
        finished.set_result(loaded)
        return finished

    def _has_loaded(self) -> bool:
        """Whether a batch can be finished; waits for it if none is being finished, and raises if loading it failed."""
        if not self._loaded and self._ahead:
            some, loading = self._ahead[0]
            if self._finished and not (loading.done() and loading.exception() is None):
                return False  # those before it are returned first
            self._ahead.popleft()
            self._loaded.extend(loading.result()[: len(some)])
        return bool(self._loaded)

    def state(self) -> dict[str, Any]:
        """Return the position as JSON values: `batches(..., start=state)` resumes with the batch that would be next."""
        return {"position": self._position, "of": self._settings}

    def close(self) -> None:
        """Stop prefetching and end the iteration."""
        for waiting in self._ahead, self._loaded, self._finished:
            waiting.clear()
        self._end()

    def _has_room(self) -> bool:
        return self._next - self._position + self._together <= self._most

    def _positions(self) -> range:
        """Return the positions to load next; none at the end."""
        stop = self._next + self._together
        return range(self._next, stop if self._count is None else min(stop, self._count))

    def _padded(self, some: range) -> range:
        """Return as many positions as in the loads before, because fewer may need a program that is not compiled."""
        only_load = self._count is not None and self._count <= self._together
        return some if only_load else range(some.start, some.start + self._together)


def _stop(*pools: ThreadPoolExecutor) -> None:
    for pool in pools:
        pool.shutdown(wait=False, cancel_futures=True)


def batches_of(
    load: Callable[[range], Sequence[Any]],
    order: EpochOrder,
    settings: dict[str, Any],
    epochs: int | None,
    prefetch: int | None,
    start: Any,
    together: int = 1,
    finish: Callable[[Any], T] | None = None,
) -> Batches[T]:
    """Iterate over the batches of epochs in an order.

    Other arguments as `Batches`; `prefetch` None: two loads per core. Else one load returns at most half the batches
    that may be in memory, so that the next load begins before they are used up.
    """
    if epochs is not None and epochs < 0:
        raise UserError(f"epochs is {epochs}: it must be at least 0, or None for endless batches.")
    settings |= {"batch_size": order.batch_size, "seed": order.seed, "process_count": order.process_count}
    count = None if epochs is None else epochs * order.batches
    if prefetch is None:
        return Batches(load, count, settings, 2 * together * len(own_cores()), start, together, finish)
    return Batches(load, count, settings, max(prefetch, 0), start, max(1, min(together, (prefetch + 1) // 2)), finish)


def _position_in(start: Any, settings: Mapping[str, Any]) -> int:
    try:
        if type(position := start["position"]) is not int or position < 0:
            raise ValueError
        saved = dict(start["of"])
        differing = [name for name in settings if saved[name] != settings[name]]
    except (KeyError, TypeError, ValueError):
        raise UserError("The start is not a state of batches: pass what their state() returned.") from None
    if differing:
        changes = ", ".join(f"{name} was {saved[name]}, now {settings[name]}" for name in differing)
        raise UserError(f"The start was saved with other settings ({changes}): use the same ones.")
    return position
