"""Orbax without what it writes on stderr about failures that it raises as well."""

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class _ForgivingLoop(asyncio.SelectorEventLoop):
    """An event loop that may be told of the end of a write after it was closed, and says nothing of it.

    The first write that fails ends the loop that Orbax waits in. TensorStore's others end later, each with a traceback.
    """

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any, context: Any = None) -> asyncio.Handle:
        try:
            return super().call_soon_threadsafe(callback, *args, context=context)
        except RuntimeError:
            if not self.is_closed():
                raise
            return asyncio.Handle(callback, args, self, context)

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Of an exception that nobody has asked a write for."""


class _ForgivingPolicy(asyncio.DefaultEventLoopPolicy):
    def new_event_loop(self) -> asyncio.AbstractEventLoop:
        return _ForgivingLoop()


@contextmanager
def quiet_failures() -> Iterator[None]:
    """While this lasts, a failure of Orbax is an exception and nothing else."""
    logger, policy = logging.getLogger("absl"), asyncio.get_event_loop_policy()
    was_disabled, logger.disabled = logger.disabled, True
    asyncio.set_event_loop_policy(_ForgivingPolicy())
    try:
        yield
    finally:
        logger.disabled = was_disabled
        asyncio.set_event_loop_policy(policy)
