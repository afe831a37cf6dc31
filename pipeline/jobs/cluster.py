"""The executor on Ray, and the only import of it: one worker per core or GPU, replaced when it dies.

Workers write their shards and fragments themselves; only summaries travel. Knows nothing of what a unit is made of.
"""

import io
import logging
import os
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

os.environ |= {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing leaves the machine
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run`: use this environment, do not build another per worker
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # keeps Ray from warning about it
}

import ray
from ray.exceptions import ActorDiedError, RayError

from configs.schema import JobConfig
from pipeline.errors import Failure, UserError
from pipeline.jobs.progress import Board
from pipeline.jobs.schedule import COMPANY, Outcome, Queue, WorkUnit
from pipeline.runtime import interruptible, own_cores, prepare_jax

OBJECT_STORE = 80 * 2**20  # bytes; next to nothing travels
POLL = 0.25  # s between looks at the workers
REACH = 5.0  # s in which a cluster has to answer
ROOM = 60.0  # s without any worker after which people are told why
STARTS = 3  # workers in a row that do not start, after which a place is given up


class Worker:
    """An actor that attempts units, all in one pool of slots, and tells how far it is meanwhile."""

    def __init__(self, job: JobConfig, split: Path, core: int | None) -> None:
        prepare_jax(core)
        self._job, self._split, self._pool = job, split, None
        self._totals: dict[str, tuple[int, float, int] | None] = {}  # by unit; None: its levels are not in the pool yet
        self._making = Lock()

    def attempt(self, unit: WorkUnit) -> Outcome:
        from pipeline.jobs.unit import attempt, pool_for  # imports what reads the settings made in __init__

        def report(env_steps: int, levels: float, solved: int) -> None:
            self._totals[unit.name] = env_steps, levels, solved

        self._totals[unit.name] = None
        with self._making:
            if self._pool is None or self._pool.error:
                self._pool = pool_for(self._job)
            pool = self._pool
        return attempt(self._job, self._split, unit, report, pool)

    def progress(self, names: list[str]) -> tuple[dict[str, tuple[int, float, int]], int]:
        """Of these units under way env steps, levels and solved levels; and how many levels more there is room for."""
        totals = {name: now for name in names if (now := self._totals.get(name)) is not None}
        return totals, self._pool.wants if self._pool and len(totals) == len(names) else 0


@dataclass
class Slot:
    """A place for one worker: what it occupies, who is in it and what it does."""

    job: JobConfig
    split: Path
    core: int | None
    gpus: int
    actor: Any = None
    starting: Any = None  # reference to the new worker's first answer
    failed_starts: int = 0  # in a row
    why: str = ""  # of the last of them
    running: dict[Any, WorkUnit] = field(default_factory=dict)  # by reference to the coming Outcome
    wants: int = 1  # levels it has room for
    look: Any = None  # reference to the coming progress

    def start(self) -> None:
        """Ask for a worker. It gets no unit before it answers: a cluster may have no room for it now, or ever."""
        # one thread for each unit, and one that answers `progress`
        options = {"num_cpus": 1, "num_gpus": self.gpus, "max_concurrency": max(COMPANY) + 1, "max_restarts": 0}
        self.actor = ray.remote(Worker).options(**options).remote(self.job, self.split, self.core)
        self.starting, self.look, self.wants = self.actor.progress.remote([]), None, 1

    def started(self) -> None:
        """The new worker has answered, or died."""
        try:
            ray.get(self.starting)
        except RayError as error:
            self.actor, self.failed_starts, self.why = None, self.failed_starts + 1, _told(error)
        else:
            self.failed_starts = 0
        self.starting = None

    def take(self, queue: Queue) -> bool:
        """Give the worker the queue's next unit, if it has room for it."""
        if self.actor is None or self.starting is not None or (self.running and self.wants <= 0):
            return False
        unit = queue.take(self.running.values())
        if unit is None:
            return False
        self.running[self.actor.attempt.remote(unit)] = unit
        self.wants -= len(unit.level_ids)
        self.look = None  # the last one did not see this unit
        return True

    def outcome(self, result: Any) -> Outcome:
        """The finished attempt; a worker that died leaves its place to a new one."""
        unit = self.running.pop(result)
        try:
            return ray.get(result)
        except RayError as error:
            self.actor = None
            return Outcome(unit, reason=f"{error}\n\n{_told(error)}")

    def watch(self, board: Board) -> None:
        """Fetch the worker's progress when it is there, without waiting."""
        if self.actor is None or not self.running:
            return
        units = {unit.name: unit for unit in self.running.values()}
        if self.look is not None:
            if not ray.wait([self.look], timeout=0)[0]:
                return
            try:
                totals, self.wants = ray.get(self.look)
            except RayError:  # its attempts fail, too, and are dealt with there
                return
            for name in totals.keys() & units.keys():
                board.tally.progress(units[name], *totals[name])
        self.look = self.actor.progress.remote(list(units))


def _told(error: RayError) -> str:
    """Ray's account of a worker's end, in a sentence without an end."""
    lines = str(error).strip().splitlines()
    if isinstance(error, ActorDiedError):
        return lines[-1] if error.actor_init_failed else "The worker died; if memory ran out, `dmesg` says so"
    return f"The worker died: {lines[0].rstrip('.')}"


def run(job: JobConfig, split: Path, queue: Queue, settle: Callable[[Sequence[Outcome]], None], board: Board) -> None:
    """Work on the queue until it is empty.

    Raises:
        UserError: the cluster of RAY_ADDRESS cannot be reached.
        Failure: no worker can start.
    """
    with connected():
        slots = [Slot(job, split.absolute(), *of) for of in _places()[: job.workers or None]]
        notice_at = time.monotonic() + ROOM
        while True:
            _start_workers(slots, len(queue.waiting))
            while sum(slot.take(queue) for slot in slots):
                pass
            busy = {result: slot for slot in slots for result in slot.running}
            if not busy and not queue.waiting:
                return
            starting = {slot.starting: slot for slot in slots if slot.starting is not None}
            both = [*busy, *starting]
            ended = ray.wait(both, num_returns=len(both), timeout=POLL)[0]
            for result in starting.keys() & set(ended):
                starting[result].started()
            slots = _usable(slots, board)
            settle([busy[result].outcome(result) for result in ended if result in busy])
            for slot in slots:
                slot.watch(board)
            board.refresh()
            if busy:
                notice_at = time.monotonic() + ROOM
            elif time.monotonic() > notice_at:
                board.say("No worker has started yet: `ray status` tells what the cluster has free.")
                notice_at = float("inf")


def _usable(slots: list[Slot], board: Board) -> list[Slot]:
    """Those where workers start.

    Raises:
        Failure: there are none.
    """
    usable = [slot for slot in slots if slot.failed_starts < STARTS]
    for slot in slots:
        if not usable:
            raise Failure(f"No worker can start ({slot.why}): executor=inline may tell more.")
        if slot not in usable:
            board.say(f"A worker cannot start ({slot.why}): its place is given up, {len(usable)} left.")
    return usable


def _start_workers(slots: Sequence[Slot], waiting: int) -> None:
    """Where there is none, and more units wait than workers are starting."""
    starting = sum(slot.starting is not None for slot in slots)
    free = [slot for slot in slots if slot.actor is None and not slot.running]
    for slot in free[: max(0, waiting - starting)]:
        slot.start()


@contextmanager
def connected() -> Iterator[None]:
    """The cluster of RAY_ADDRESS, or one on this machine that lives as long as this block and this process.

    Raises:
        UserError: there is none at RAY_ADDRESS.
    """
    if _existing():
        _require_reachable(os.environ["RAY_ADDRESS"])
        settings: dict[str, Any] = {}
    else:
        settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE, "num_cpus": len(own_cores())}
        settings["address"] = "local"  # not one that somebody has started here and RAY_ADDRESS does not name
    with redirect_stdout(io.StringIO()):  # where Ray has a long word of its own to each worker's death
        try:
            ray.init(log_to_driver=False, logging_level=logging.FATAL, **settings)
        except ConnectionError as error:
            raise _no_cluster(str(error).strip().splitlines()[0]) from error
        try:
            with interruptible():  # only now: Ray sets a handler of its own when it starts
                yield
        finally:
            ray.shutdown()


def _require_reachable(address: str) -> None:
    """Ray itself tries for minutes.

    Raises:
        UserError: nobody listens there.
    """
    if place := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
        try:
            socket.create_connection((place[1].strip("[]"), int(place[2])), REACH).close()
        except (OSError, OverflowError) as error:
            raise _no_cluster(getattr(error, "strerror", None) or str(error)) from error


def _no_cluster(reason: str) -> UserError:
    address = os.environ.get("RAY_ADDRESS", "")
    return UserError(
        f"There is no Ray cluster at RAY_ADDRESS={address} ({reason.rstrip('.')}): "
        "start one with `ray start --head`, correct the address, or unset it to use this machine."
    )


def _existing() -> bool:
    return bool(os.environ.get("RAY_ADDRESS"))


def _places() -> list[tuple[int | None, int]]:
    """Core and GPUs of each worker: one worker per GPU where JAX can use them, else one per core."""
    resources = ray.cluster_resources()
    if gpus := int(resources.get("GPU", 0)):
        probe = ray.remote(num_gpus=1, max_calls=1)(_jax_sees_a_gpu)
        if ray.get(probe.remote()):
            return [(None, 1)] * gpus
    if _existing():  # which cores its machines have is theirs to know
        return [(None, 0)] * int(resources["CPU"])
    return [(core, 0) for core in own_cores()]


def _jax_sees_a_gpu() -> bool:
    import jax

    return jax.default_backend() == "gpu"
