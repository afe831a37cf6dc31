"""Other processes for a command's work: to use more cores, or because this process must not have started JAX."""

import multiprocessing
import operator
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing import util
from typing import Any, TypeVar

from levelproof.pipeline.errors import Failure

GRACE = 3.0  # s for which a process may go on that was told to end: compiled code cannot be interrupted

T = TypeVar("T")


@contextmanager
def other_processes(count: int, *prepare: Any) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield a `map` whose calls run in other processes; an error or a stop of the `with` block ends these.

    Args:
        count: number of processes at most.
        prepare: function that each process calls once, before all others, and its arguments; default: none.

    Raises:
        Failure: a process died, or cannot be started.
    """
    try:
        pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _follow_parent)
    except OSError as error:
        raise Failure(f"This command cannot share a lock with another process ({error}): it needs /dev/shm.") from error

    def run(function: Callable[..., Any], *items: Any) -> Iterator[Any]:
        # A terminal sends Ctrl-C to the children, too, which would print tracebacks: they inherit this mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return pool.map(partial(_prepared, prepare, function), *items)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    others = set(multiprocessing.active_children())
    with pool:
        try:
            yield run
        except BrokenProcessPool as error:
            _end(others)
            raise Failure(
                "A process of this command died, perhaps because memory ran out: free some, then run the same command "
                "again."
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            _end(others)
            raise


def in_another_process(function: Callable[..., T], *arguments: Any) -> T:
    """Run a function in another process: it starts JAX, and Ray forks this one. Raises as `other_processes`."""
    with other_processes(1) as run:
        return next(run(operator.call, [partial(function, *arguments)]))


def _prepared(prepare: tuple[Any, ...], function: Callable[..., T], *item: Any) -> T:
    if prepare:
        _once(*prepare)
    return function(*item)


@cache
def _once(function: Callable[..., None], *arguments: Any) -> None:
    function(*arguments)


def _follow_parent() -> None:
    """Let this process end as soon as SIGTERM comes or its parent dies.

    SIGTERM itself would end it without the finalizers of its libraries' locks, and the parent would warn of leaks.
    SystemExit would not end it: the pool returns that as the result of a call.
    """
    signal.signal(signal.SIGTERM, _leave)
    if parent := multiprocessing.parent_process():
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _leave(*_: object) -> None:
    util._run_finalizers()  # pyright: ignore[reportAttributeAccessIssue]
    os._exit(128 + signal.SIGTERM)


def _end(others: set[Any]) -> None:
    """End this process's children except `others`: by force after GRACE, or once this process is stopped again."""
    children, end = set(multiprocessing.active_children()) - others, time.monotonic() + GRACE
    try:
        for child in children:
            child.terminate()
        for child in children:
            child.join(max(end - time.monotonic(), 0))
    finally:
        for child in children:
            if child.is_alive():
                child.kill()
