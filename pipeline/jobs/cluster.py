"""The executor on Ray, and the only import of it: one worker per core or GPU, replaced when it dies.

Workers write their shards and fragments themselves; only summaries travel. Knows nothing of what a unit is made of.
"""

import io
import logging
import os
import signal
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ |= {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing leaves the machine
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run`: use this environment, do not build another per worker
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # keeps Ray from warning about it
}

import ray
from ray._private import ray_constants
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayError
from ray.util.metrics import Gauge
from ray.util.placement_group import placement_group, remove_placement_group
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy, PlacementGroupSchedulingStrategy

from levelproof.configs.schema import JobConfig
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.jobs.address import existing, no_cluster, require_reachable
from levelproof.pipeline.jobs.likeness import Program, program_of, seen_from_elsewhere, unlike
from levelproof.pipeline.jobs.meters import Meters
from levelproof.pipeline.jobs.places import bytes_of_worker, places, share_of_memory, shortage
from levelproof.pipeline.jobs.progress import STOPPING, Board
from levelproof.pipeline.jobs.schedule import Order, Round, Scheduler, Settle, UnitOutcome, levels_text, until_report
from levelproof.pipeline.runtime import NO_GPU, jax_sees_a_gpu, own_core, own_cores, prepare_jax
from levelproof.pipeline.stopping import Stop
from levelproof.pipeline.store.leases import serve, served
from levelproof.pipeline.store.remote import absolute
from levelproof.pipeline.words import duration

OBJECT_STORE = 80 * 2**20  # bytes; next to nothing travels
POLL = 0.25  # s after which people see progress, whether a worker has reported or not
RESCAN = 5.0  # s between looks at which machines a cluster has
GPU_PATIENCE = 10.0  # s of waiting for a GPU that is free, after which workers do without
PATIENCE = 60.0  # s without any worker after which people are told why
STARTS = 3  # times in a row that a worker does not start, after which its place is given up
MAX_SILENT = 1800.0  # s without a word after which a worker is given up; a large program compiles for minutes


class WorkerActor:
    """A worker in a process of its own. Calls are short (see `schedule.ROUND`), so that one thread suffices."""

    def begin(self, program: Program, job: JobConfig, split: Path, neighbours: int, writer: str) -> str:
        """Get ready; why not, where another program runs here. `neighbours` as in `runtime.own_core`, `writer` as in
        `leases.serve`."""
        if refusal := unlike(program, job):
            return refusal
        prepare_jax(own_core(neighbours), job.device)
        from levelproof.pipeline.jobs.worker import Worker  # imports what reads the settings just made

        serve(split, writer)
        self._worker, self._at_work, self._rounds = Worker(job, split), False, 0
        self._before = signal.signal(signal.SIGTERM, self._asked_to_go)
        return ""

    def work(self, order: Order, seconds: float) -> Round:
        """A round, which ends early when the driver cancels it: nothing else reaches a worker in the middle of one."""
        self._at_work = True
        try:
            self._latest = self._worker.work(order, seconds, ray.get_runtime_context().is_canceled)
            self._rounds += 1
            return self._latest
        finally:
            self._at_work = False

    def leave(self, heard: int) -> list[Round]:
        """Commit what is decided, and leave. The latest round comes first if the driver, which has heard of so many
        rounds, has not heard of it."""
        return [*([self._latest] if self._rounds > heard else []), self._worker.leave()]

    def _asked_to_go(self, number: int, frame: Any) -> None:
        """SIGTERM: with units under way, leave after the step that is under way; else at once."""
        self._worker.stopping = True
        if not self._at_work and callable(self._before):
            self._before(number, frame)


@dataclass(eq=False)
class WorkerHandle:
    """A worker as the driver sees it: where it is, and whether there is one now."""

    node: str  # Ray's id of its machine
    host: str
    memory: int = 0  # bytes that Ray reserves for it
    actor: Any = None
    answer: Any = None  # reference to what it will answer: to `begin`, then to `work`
    up: bool = False  # it has begun
    heard: int = 0  # rounds that it has reported
    out_of_reach: bool = False  # it is asked whether it is there
    failed_starts: int = 0  # in a row
    why: str = ""  # of the last of them

    @property
    def starting(self) -> bool:
        return self.actor is not None and not self.up

    @property
    def free(self) -> bool:
        """Whether it can be told of units now."""
        return self.up and self.answer is None

    def start(self, name: str, gpus: int, *begin: Any) -> None:
        """Ask for a worker. It gets no unit before it answers: its machine may have no room for it now, or ever."""
        here = NodeAffinitySchedulingStrategy(self.node, soft=False)
        resources = {"num_cpus": 1, "num_gpus": gpus, "memory": self.memory}
        options = {"max_restarts": 0, "scheduling_strategy": here, **resources}
        self.actor = ray.remote(WorkerActor).options(name=f"{name} on {self.host}", **options).remote()
        self.answer = self.actor.begin.remote(*begin)

    def end(self) -> None:
        """It dies, if it is not dead; its place is free for another."""
        if self.actor is not None:
            ray.kill(self.actor)
        self.actor, self.answer, self.up, self.heard, self.out_of_reach = None, None, False, 0, False


def _told(error: RayError) -> str:
    """Ray's account of a worker's end, in a sentence without an end."""
    lines = str(error).strip().splitlines()
    if isinstance(error, ActorDiedError):
        return lines[-1] if error.actor_init_failed else "The worker died; if memory ran out, `dmesg` says so"
    return f"The worker died: {lines[0].rstrip('.')}"


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Work until nothing is left to do; `stop` is heeded.

    Raises:
        UserError: the cluster of RAY_ADDRESS cannot be reached.
        Failure: no worker can start.
        KeyboardInterrupt: somebody asked for the end; what could be kept is committed.
    """
    with connected(), stop.heeded():  # in this order: Ray sets a handler of its own when it starts
        crew = Crew(seen_from_elsewhere(job), absolute(split), scheduler, board, served(split))
        while not scheduler.over:
            crew.follow_cluster()
            crew.start_workers()
            crew.order()
            settle(crew.wait())
            board.refresh()
            if stop.asked.is_set():
                board.say(STOPPING)
                settle(crew.leave(stop.grace))
                raise KeyboardInterrupt


class Crew:
    """All workers of a job: a place for each core or GPU of each machine."""

    def __init__(self, job: JobConfig, split: Path, scheduler: Scheduler, board: Board, writer: str = "") -> None:
        """`writer` is the name under which the driver has the split; workers that get none commit beside no writer."""
        if why := _why_no_gpu() if job.device == "gpu" else "":
            board.say(f"Workers use CPU cores, not GPUs: {why}.")
        self._gpus = job.device == "gpu" and not why
        self._job = replace(job, device="gpu" if self._gpus else "cpu")
        self._split, self._scheduler, self._board, self._writer = split, scheduler, board, writer
        units = -(-scheduler.waiting // job.levels_per_unit)
        self._most = max(1, min(job.workers or units, units))
        self._kind, self._memory = "GPU" if self._gpus else "CPU", bytes_of_worker(size_of(job.size))
        self._handles: list[WorkerHandle] = []
        self._refused: set[str] = set()  # machines
        self._short: set[str] = set()  # machines whose lack of memory people know of
        self._given_up: Counter[str] = Counter()  # workers that cannot start, by machine
        self._started = 0
        self._meters = Meters(split, Gauge) if existing() else None
        self._rescan_at = 0.0
        self._notice_at = time.monotonic() + PATIENCE

    def follow_cluster(self) -> None:
        """As many workers as the machines have room for now; one on this machine alone has always the same."""
        if time.monotonic() < self._rescan_at:
            return
        self._rescan_at = time.monotonic() + RESCAN if existing() else float("inf")
        if self._meters:
            self._meters.show(self._board.tally)
        machines = {node: of for node, of in _machines().items() if node not in self._refused}
        room = places(machines, self._kind, self._most, self._memory)
        for handle in [handle for handle in self._handles if not handle.up]:
            if sum(of.node == handle.node for of in self._handles) > room[handle.node]:
                handle.end()
                self._handles.remove(handle)
        for node, count in room.items():
            there = sum(handle.node == node for handle in self._handles) + self._given_up[node]
            host, memory = machines[node]["NodeManagerHostname"], share_of_memory(machines[node], self._memory)
            self._handles += [WorkerHandle(node, host, memory) for _ in range(count - there)]
            if node not in self._short and (why := shortage(machines[node], self._kind, self._most, self._memory)):
                self._short.add(node)
                self._board.say(why)
        del self._handles[self._most :]

    def start_workers(self) -> None:
        """Where there is none, and more levels wait than workers are starting."""
        starting = sum(handle.starting for handle in self._handles)
        without = [handle for handle in self._handles if handle.actor is None]
        for handle in without[: max(0, self._scheduler.waiting - starting)]:
            self._started += 1
            name = f"levelproof {self._job.budget}/{self._job.size} worker {self._started}"
            neighbours = 0 if self._gpus else sum(of.node == handle.node for of in self._handles)
            begin = program_of(self._job), self._job, self._split, neighbours, self._writer
            handle.start(name, int(self._gpus), *begin)

    def order(self) -> None:
        """Give units to the workers that have reported, and let them go on."""
        self._scheduler.share()
        for handle in self._handles:
            if handle.free:
                order = self._scheduler.order(handle, time.monotonic())
                if self._scheduler.workers[handle].units:
                    handle.answer = handle.actor.work.remote(order, until_report(order, len(self._handles)))

    def wait(self) -> list[UnitOutcome]:
        """Outcomes of the rounds that are over, if any ends in a moment."""
        asked = {handle.answer: handle for handle in self._handles if handle.answer is not None}
        self._notice_silence(any(handle.up for handle in self._handles))
        if not asked:
            time.sleep(POLL)
            return []
        outcomes = self._heard(asked, POLL)
        for handle in self._scheduler.silent(time.monotonic() - MAX_SILENT):
            outcomes += self._lose(handle, f"The worker on {handle.host} was silent for {duration(MAX_SILENT)}")
        self._give_up()
        return outcomes

    def leave(self, seconds: float) -> list[UnitOutcome]:
        """Outcomes of what all workers could still commit within so many seconds. Rounds, which are long where there
        are thousands of workers, end now."""
        end = time.monotonic() + seconds
        for handle in self._handles:
            if handle.up:
                if handle.answer is not None:
                    ray.cancel(handle.answer)
                handle.answer = handle.actor.leave.remote(handle.heard)
        outcomes: list[UnitOutcome] = []
        while (last := {handle.answer: handle for handle in self._handles if handle.up}) and time.monotonic() < end:
            outcomes += self._heard(last, max(0.0, end - time.monotonic()))
        return outcomes

    def _heard(self, asked: Mapping[Any, WorkerHandle], seconds: float) -> list[UnitOutcome]:
        """Outcomes that the answers of these workers tell of, if any answers within so many seconds."""
        ray.wait([*asked], timeout=seconds)  # for the first
        ready, _ = ray.wait([*asked], num_returns=len(asked), timeout=0)
        outcomes: list[UnitOutcome] = []
        for handle in (asked[reference] for reference in ready):
            if handle.answer is not None:  # else it has ended: one beside it was refused, and with it its machine
                outcomes += self._hear(handle)
        return outcomes

    def _hear(self, handle: WorkerHandle) -> Sequence[UnitOutcome]:
        """What a worker has answered; where one died or left, another takes its place."""
        over, handle.answer = handle.answer, None
        try:
            answer: Any = ray.get(over)
        except ActorUnavailableError:  # Ray knows soon whether it died, and whether its machine did
            handle.answer, handle.out_of_reach = handle.actor.__ray_ready__.remote(), True
            return []
        except RayError as error:
            return self._lose(handle, f"{error}\n\n{_told(error)}", _told(error))
        if handle.out_of_reach:
            return self._lose(handle, "The worker was out of reach", "The worker was out of reach")
        if not handle.up:
            if answer:
                self._refuse(handle, answer)
                return []
            handle.up, handle.failed_starts = True, 0
            self._scheduler.join(handle, time.monotonic())
            return []
        rounds = answer if isinstance(answer, list) else [answer]  # none follows the one with which it has left
        return [outcome for round in rounds if handle.up for outcome in self._report(handle, round)]

    def _report(self, handle: WorkerHandle, round: Round) -> Sequence[UnitOutcome]:
        """A round's outcomes; what else it tells goes to those whom it concerns."""
        handle.heard += 1
        self._scheduler.report(handle, round, time.monotonic())
        self._board.tally.follow(round)
        if round.leaves:
            self._scheduler.leave(handle)
            handle.end()
        return round.outcomes

    def _lose(self, handle: WorkerHandle, reason: str, told: str = "") -> Sequence[UnitOutcome]:
        """A worker died. Where its machine did, that is no fault of its units."""
        was_up, gone = handle.up, handle.node not in _machines()
        handle.end()
        if gone:
            self._rescan_at = 0.0
        elif not was_up:
            handle.failed_starts, handle.why = handle.failed_starts + 1, told
        if was_up and gone:
            units = self._scheduler.workers[handle].units
            self._board.say(f"{handle.host} is gone; others go on with {levels_text(units) if units else 'its work'}.")
            self._hand_on(handle)
        return self._scheduler.lost(handle, reason) if was_up and not gone else []

    def _hand_on(self, handle: WorkerHandle) -> None:
        """Let others go on with what a worker has that is gone."""
        self._board.tally.forget(self._scheduler.workers[handle].units)
        self._scheduler.leave(handle)

    def _refuse(self, handle: WorkerHandle, why: str) -> None:
        """No worker on this machine, which has another program.

        Raises:
            Failure: there are no others.
        """
        handle.end()
        self._refused.add(handle.node)
        for other in [other for other in self._handles if other.node == handle.node]:
            if other.up:
                self._hand_on(other)
            other.end()
            self._handles.remove(other)
        if not self._handles:
            raise Failure(why)
        self._board.say(f"{why.rstrip('.')}; its workers are left out.")

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
                self._given_up[handle.node] += 1
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
    ray_constants.ENABLE_RAY_CLUSTER = bool(existing())  # otherwise Ray listens on loopback
    if existing():
        require_reachable(existing())
        settings: dict[str, Any] = {}
    else:
        settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE, "num_cpus": len(own_cores())}
        settings["address"] = "local"  # not one that somebody has started here and RAY_ADDRESS does not name
    with redirect_stdout(io.StringIO()):  # where Ray has a long word of its own to each worker's death
        try:
            ray.init(log_to_driver=False, logging_level=logging.FATAL, **settings)
        except ConnectionError as error:
            raise no_cluster(str(error).strip().splitlines()[0]) from error
        except OSError as error:
            raise Failure(f"Ray cannot start ({error}): mend that, or have RAY_TMPDIR name another folder.") from error
        try:
            yield
        finally:
            ray.shutdown()


def _why_no_gpu() -> str:
    """Why workers cannot have GPUs; empty: the cluster has one that is free, and JAX can use it."""
    if not ray.cluster_resources().get("GPU"):
        return "the cluster has none"
    group = placement_group([{"GPU": 1}])
    try:
        if not group.wait(GPU_PATIENCE):
            return f"after {duration(GPU_PATIENCE)} of waiting, others still hold all of them"
        there = PlacementGroupSchedulingStrategy(group)
        probe = ray.remote(num_cpus=0, num_gpus=1, max_calls=1, scheduling_strategy=there)(jax_sees_a_gpu)
        return "" if ray.get(probe.remote()) else NO_GPU
    finally:
        remove_placement_group(group)


def _machines() -> dict[str, dict[str, Any]]:
    """The machines that the cluster has now, by Ray's ids."""
    return {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
