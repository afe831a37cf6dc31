"""A worker's process, as the driver calls it. Knows nothing of Ray."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.jobs.likeness import Versions, mismatch, unseen
from levelproof.pipeline.jobs.schedule import Order, Round
from levelproof.pipeline.runtime import own_core, prepare_jax, spare_imports
from levelproof.pipeline.store.leases import serve


class WorkerActor:
    """A worker in its own process. Calls are short (see `schedule.ROUND`), so one thread suffices."""

    def __init__(self, is_canceled: Callable[[], bool]) -> None:
        """`is_canceled` returns whether the driver has cancelled the current call."""
        self._is_canceled = is_canceled

    def begin(
        self, versions: Versions, job: JobConfig, split: Path, neighbours: int, writer: str
    ) -> str | tuple[int, int]:
        """Set the worker up (see `own_core`, `leases.serve`), or say why it cannot make the driver's levels.

        If the worker can share compiling with neighbours, it returns as `compile_next` does.
        """
        if refusal := mismatch(versions, job) or unseen(split, writer):
            return refusal
        prepare_jax(own_core(neighbours), job.device)
        # These modules read JAX's settings on import, so import them after JAX is set up
        from levelproof.pipeline.jobs.ahead import Ahead
        from levelproof.pipeline.jobs.worker import worker_for

        spare_imports()
        serve(split, writer)
        self._worker, self._working, self._rounds = worker_for(job, split), False, 0
        self._previous_handler = signal.signal(signal.SIGTERM, self._on_sigterm)
        if self._worker.pool is None:
            return ""
        self._ahead = Ahead(job, self._worker.pool)
        return self._ahead.compiled if neighbours > 1 and self._ahead.left else ""

    def compile_next(self) -> str | tuple[int, int]:
        """Compile a program that no neighbour compiles; return the number of compiled programs, and of all.

        Return an empty string if none is left: the worker is ready.
        """
        compiled = self._ahead.compile_next()
        self._worker.compiling = self._ahead.compiling
        return compiled or ""

    def work(self, order: Order, seconds: float) -> Round:
        """Work one round, which ends early if the driver cancels it: no other call reaches a busy worker."""
        self._working = True
        try:
            self._latest = self._worker.work(order, seconds, self._is_canceled)
            self._rounds += 1
            return self._latest
        finally:
            self._working = False

    def leave(self, heard: int) -> list[Round]:
        """Commit decided levels and leave; return the last round, after any that the driver has not `heard`."""
        return [*([self._latest] if self._rounds > heard else []), self._worker.leave()]

    def _on_sigterm(self, number: int, frame: Any) -> None:
        """Leave after the current step if the worker is in a round, else at once."""
        self._worker.stopping = True
        if not self._working and callable(self._previous_handler):
            self._previous_handler(number, frame)
