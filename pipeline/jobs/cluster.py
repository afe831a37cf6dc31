"""The executor on Ray, and the only import of it: one worker per core or GPU, replaced when it dies.

Workers write their shards and fragments themselves; only summaries travel. Knows nothing of what a unit is made of.
"""

import io
import logging
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
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
from pipeline.jobs.schedule import ROUND, Assignment, Round, Settle, UnitOutcome, UnitQueue, WorkUnit
from pipeline.runtime import cores_for, interruptible, own_cores, prepare_jax
from pipeline.store.remote import absolute, as_typed

OBJECT_STORE = 80 * 2**20  # bytes; next to nothing travels
POLL = 0.25  # s after which people see progress, whether a worker has reported or not
REACH = 5.0  # s in which a cluster has to answer
RESCAN = 5.0  # s between looks at how many workers a cluster has room for
PATIENCE = 60.0  # s without any worker after which people are told why
STARTS = 3  # workers in a row that do not start, after which no further one is tried with these resources


class WorkerActor:
    """A worker in a process of its own. Calls are short (see `schedule.ROUND`), so that one thread suffices."""

    def __init__(self, job: JobConfig, split: Path, core: int | None) -> None:
        prepare_jax(core)
        from pipeline.jobs.worker import Worker  # imports what reads the settings just made

        self._worker = Worker(job, split)

    def work(self, units: list[WorkUnit]) -> Round:
        return self._worker.work(units, ROUND)


@dataclass
class WorkerHandle:
    """A worker as the driver sees it: what it occupies, what it does, and whether there is one now."""

    job: JobConfig
    split: Path
    core: int | None  # that it stays on; None: the system or the cluster chooses
    gpus: int
    actor: Any = None
    answer: Any = None  # reference to the coming Round; its first says that it has started
    up: bool = False  # it has started
    failed_starts: int = 0  # in a row
    why: str = ""  # of the last of them
    assignment: Assignment = field(default_factory=Assignment)

    def start(self) -> None:
        """Ask for a worker. It gets no unit before it answers: a cluster may have no room for it now, or ever."""
        options = {"num_cpus": 1, "num_gpus": self.gpus, "max_restarts": 0}
        self.actor = ray.remote(WorkerActor).options(**options).remote(self.job, self.split, self.core)
        self.answer = self.actor.work.remote([])  # nothing yet: that it is there

    @property
    def starting(self) -> bool:
        return self.actor is not None and not self.up

    @property
    def free(self) -> bool:
        """Whether it can be told of units now."""
        return self.up and self.answer is None

    def report(self) -> Round:
        """What it has answered; a worker that died leaves its resources to a new one."""
        over, self.answer = self.answer, None
        try:
            round: Round = ray.get(over)  # pyright: ignore[reportAssignmentType] - one reference, one value
        except RayError as error:
            if not self.up:
                self.failed_starts, self.why = self.failed_starts + 1, _told(error)
            self.actor, self.up = None, False
            return Round(self.assignment.lose(f"{error}\n\n{_told(error)}"), {}, 0)
        if self.up:
            self.assignment.account(round)
        self.up, self.failed_starts = True, 0
        return round


def _told(error: RayError) -> str:
    """Ray's account of a worker's end, in a sentence without an end."""
    lines = str(error).strip().splitlines()
    if isinstance(error, ActorDiedError):
        return lines[-1] if error.actor_init_failed else "The worker died; if memory ran out, `dmesg` says so"
    return f"The worker died: {lines[0].rstrip('.')}"


def run(job: JobConfig, split: Path, queue: UnitQueue, settle: Settle, board: Board) -> None:
    """Work on the queue until it is empty.

    Raises:
        UserError: the cluster of RAY_ADDRESS cannot be reached.
        Failure: no worker can start.
    """
    with connected():
        crew = Crew(_seen_from_elsewhere(job), absolute(split), len(queue.waiting), board)
        while True:
            crew.follow_cluster()
            crew.start_workers(len(queue.waiting))
            crew.assign(queue)
            if not (crew.busy or queue.waiting):
                return
            settle(crew.wait())
            board.refresh()


def _seen_from_elsewhere(job: JobConfig) -> JobConfig:
    """The job as a worker in another folder has to read it: no path is relative."""
    known = lambda path: path and as_typed(absolute(Path(path)))
    return replace(job, out=known(job.out), continue_from=known(job.continue_from))


class Crew:
    """All workers of a job."""

    def __init__(self, job: JobConfig, split: Path, units: int, board: Board) -> None:
        self._job, self._split, self._board = job, split, board
        self._most = min(job.workers or units, units)
        self._gpus = _on_gpus()
        self._handles = list(map(self._handle, _room(self._gpus, self._most)))
        self._given_up = 0  # workers that cannot start
        self._rescan_at = time.monotonic() + RESCAN
        self._notice_at = time.monotonic() + PATIENCE

    def _handle(self, core: int | None) -> WorkerHandle:
        return WorkerHandle(self._job, self._split, core, int(self._gpus))

    @property
    def busy(self) -> bool:
        return any(handle.assignment.units for handle in self._handles)

    def follow_cluster(self) -> None:
        """As many workers as a cluster has room for now; one on this machine has always the same."""
        if not _existing() or time.monotonic() < self._rescan_at:
            return
        self._rescan_at = time.monotonic() + RESCAN
        room = _room(self._gpus, self._most)
        surplus = len(self._handles) + self._given_up - len(room)
        self._handles += map(self._handle, room[: max(0, -surplus)])
        gone = [handle for handle in self._handles if not handle.up]
        for handle in gone[: max(0, min(surplus, len(self._handles) - 1))]:
            if handle.actor is not None:
                ray.kill(handle.actor)
            self._handles.remove(handle)

    def start_workers(self, waiting: int) -> None:
        """Where there is none, and more units wait than workers are starting."""
        starting = sum(handle.starting for handle in self._handles)
        without = [handle for handle in self._handles if handle.actor is None]
        for handle in without[: max(0, waiting - starting)]:
            handle.start()

    def assign(self, queue: UnitQueue) -> None:
        """Give units to the workers that have reported, and let them go on. Each gets one before any gets two."""
        free = [handle for handle in self._handles if handle.free]
        starting = sum(handle.starting for handle in self._handles)
        while any(
            handle.assignment.take(queue)
            for handle in free
            if not handle.assignment.units or len(queue.waiting) > starting
        ):
            pass
        for handle in free:
            if handle.assignment.units:
                handle.answer = handle.actor.work.remote(handle.assignment.units)

    def wait(self) -> list[UnitOutcome]:
        """Outcomes of the rounds that are over, if any ends in a moment."""
        asked = {handle.answer: handle for handle in self._handles if handle.answer is not None}
        self._notice_silence(any(handle.up for handle in asked.values()))
        ray.wait([*asked], timeout=POLL)  # for the first
        outcomes: list[UnitOutcome] = []
        for reference in ray.wait([*asked], num_returns=len(asked), timeout=0)[0]:
            round = asked[reference].report()
            outcomes += round.outcomes
            self._board.tally.running.update(round.totals)
        self._give_up()
        return outcomes

    def _give_up(self) -> None:
        """Leave out workers that do not start.

        Raises:
            Failure: there are no others.
        """
        usable = [handle for handle in self._handles if handle.failed_starts < STARTS]
        for handle in self._handles:
            if not usable:
                raise Failure(f"No worker can start ({handle.why}): executor=inline may tell more.")
            if handle not in usable:
                self._given_up += 1
                self._board.say(f"A worker cannot start ({handle.why}): it is given up, {len(usable)} left.")
        self._handles = usable

    def _notice_silence(self, working: bool) -> None:
        """Say once why nothing happens."""
        if working:
            self._notice_at = time.monotonic() + PATIENCE
        elif time.monotonic() > self._notice_at:
            self._board.say("No worker has started yet: `ray status` tells what the cluster has free.")
            self._notice_at = float("inf")


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
    if found := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
        try:
            socket.create_connection((found[1].strip("[]"), int(found[2])), REACH).close()
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


def _on_gpus() -> bool:
    """Whether each worker gets a GPU: where there are some, and JAX can use them."""
    if not ray.cluster_resources().get("GPU"):
        return False
    return ray.get(ray.remote(num_gpus=1, max_calls=1)(_jax_sees_a_gpu).remote())


def _room(gpus: bool, most: int) -> list[int | None]:
    """The core of each worker for which there is room now: one for each GPU or core, and at most so many."""
    if not (gpus or _existing()):
        return cores_for(most)
    room = ray.cluster_resources().get("GPU" if gpus else "CPU", 0)  # which cores a cluster has is its to know
    return [None] * min(max(int(room), 1), most)  # one that waits: more machines may join


def _jax_sees_a_gpu() -> bool:
    import jax

    return jax.default_backend() == "gpu"
