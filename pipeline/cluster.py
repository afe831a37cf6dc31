"""The executor on Ray, and the only import of it: one worker per core or GPU, replaced when it dies.

Workers write their shards and fragments themselves; only summaries travel. Knows nothing of what a unit is made of.
"""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ |= {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing leaves the machine
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run`: use this environment, do not build another per worker
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # keeps Ray from warning about it
}

import ray
from ray.exceptions import RayError

from configs.schema import JobConfig
from pipeline.progress import Board
from pipeline.runtime import interruptible, own_cores, prepare_jax
from pipeline.schedule import Outcome, Queue, WorkUnit

OBJECT_STORE = 80 * 2**20  # bytes; next to nothing travels
POLL = 0.25  # s between looks at the workers


class Worker:
    """An actor that attempts units, one at a time, and tells how far it is meanwhile."""

    def __init__(self, core: int | None) -> None:
        prepare_jax(core)
        self._progress = 0, 0.0, 0

    def attempt(self, job: JobConfig, split: Path, unit: WorkUnit) -> Outcome:
        from pipeline.unit import attempt  # imports what reads the settings made in __init__

        def report(env_steps: int, levels: float, solved: int) -> None:
            self._progress = env_steps, levels, solved

        self._progress = 0, 0.0, 0
        return attempt(job, split, unit, report)

    def progress(self) -> tuple[int, float, int]:
        """Env steps, levels and solved levels of the unit under way."""
        return self._progress


@dataclass
class Slot:
    """A place for one worker: what it occupies, who is in it and what it does."""

    core: int | None
    gpus: int
    actor: Any = None
    unit: WorkUnit | None = None
    result: Any = None  # reference to the coming Outcome
    look: Any = None  # reference to the coming progress

    def start(self, job: JobConfig, split: Path, unit: WorkUnit) -> None:
        if self.actor is None:
            # two threads: one attempts, the other answers `progress`
            options = {"num_cpus": 1, "num_gpus": self.gpus, "max_concurrency": 2, "max_restarts": 0}
            self.actor = ray.remote(Worker).options(**options).remote(self.core)
        self.unit, self.result, self.look = unit, self.actor.attempt.remote(job, split, unit), None

    def outcome(self) -> Outcome:
        """The finished attempt; a worker that died leaves its place to a new one."""
        unit, self.unit = self.unit, None
        assert unit is not None
        try:
            return ray.get(self.result)
        except RayError as error:
            self.actor = None
            sentence = str(error).strip().splitlines()[0]
            return Outcome(unit, reason=f"{error}\n\nThe worker died: {sentence}")

    def watch(self, board: Board) -> None:
        """Fetch the worker's progress when it is there, without waiting."""
        if self.unit is None:
            return
        if self.look is not None:
            if not ray.wait([self.look], timeout=0)[0]:
                return
            try:
                board.tally.progress(self.unit, *ray.get(self.look))
            except RayError:  # its attempt fails, too, and is dealt with there
                return
        self.look = self.actor.progress.remote()


def run(job: JobConfig, split: Path, queue: Queue, settle: Callable[[Outcome], None], board: Board) -> None:
    """Work on the queue until it is empty."""
    with connected():
        slots = _slots()[: job.workers or None]
        while True:
            for slot in slots:
                if slot.unit is None and (unit := queue.take()):
                    slot.start(job, split.absolute(), unit)
            busy = {slot.result: slot for slot in slots if slot.unit}
            if not busy:
                return
            for result in ray.wait(list(busy), num_returns=len(busy), timeout=POLL)[0]:
                settle(busy[result].outcome())
            for slot in slots:
                slot.watch(board)
            board.refresh()


@contextmanager
def connected() -> Iterator[None]:
    """The cluster of RAY_ADDRESS, or one on this machine that lives as long as this block and this process."""
    if _existing():
        settings: dict[str, Any] = {}
    else:
        settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE, "num_cpus": len(own_cores())}
    ray.init(log_to_driver=False, logging_level=logging.FATAL, **settings)
    try:
        with interruptible():  # only now: Ray sets a handler of its own when it starts
            yield
    finally:
        ray.shutdown()


def _existing() -> bool:
    return bool(os.environ.get("RAY_ADDRESS"))


def _slots() -> list[Slot]:
    """One place per GPU where JAX can use them, else one per core."""
    resources = ray.cluster_resources()
    if gpus := int(resources.get("GPU", 0)):
        probe = ray.remote(num_gpus=1, max_calls=1)(_jax_sees_a_gpu)
        if ray.get(probe.remote()):
            return [Slot(None, 1) for _ in range(gpus)]
    if _existing():  # which cores its machines have is theirs to know
        return [Slot(None, 0) for _ in range(int(resources["CPU"]))]
    return [Slot(core, 0) for core in own_cores()]


def _jax_sees_a_gpu() -> bool:
    import jax

    return jax.default_backend() == "gpu"
