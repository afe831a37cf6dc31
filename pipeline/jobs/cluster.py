"""The executor on Ray, and the only file that imports Ray: one worker per core or GPU, replaced when it dies.

Workers write their own shards and fragments; only summaries travel. Knows nothing of what a unit contains.
"""

import io
import logging
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ |= {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing leaves the machine
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run`: use this environment, do not build another per worker
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # Ray warns if this is unset
}

import ray
from ray._private import ray_constants
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayError, RayTaskError
from ray.util.metrics import Gauge
from ray.util.placement_group import placement_group, remove_placement_group
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy, PlacementGroupSchedulingStrategy

from levelproof.configs.schema import JobConfig
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Failure, last_line
from levelproof.pipeline.jobs.actor import WorkerActor
from levelproof.pipeline.jobs.address import cannot_start, noticing_slow_starts, ray_address, require_reachable
from levelproof.pipeline.jobs.choice import most_workers
from levelproof.pipeline.jobs.likeness import versions_of, with_absolute_paths
from levelproof.pipeline.jobs.places import bytes_of_worker, memory_to_reserve, shortage, workers_by_machine
from levelproof.pipeline.jobs.progress import STOPPING, Board, Meters
from levelproof.pipeline.jobs.schedule import Round, Scheduler, Settle, UnitOutcome, levels_text, until_report
from levelproof.pipeline.runtime import NO_GPU, jax_sees_a_gpu, own_cores
from levelproof.pipeline.stopping import GRACE, Stop
from levelproof.pipeline.store.leases import require_served, served
from levelproof.pipeline.store.remote import absolute
from levelproof.pipeline.words import duration

OBJECT_STORE = 80 * 2**20  # bytes; close to Ray's minimum, because only summaries travel
STARTING = 1.0  # s to start workers before the driver looks at answers and signals again; Ray takes some 10 ms each
POLL = 0.25  # s between progress updates, whether a worker has reported or not
RESCAN = 5.0  # s between checks for machines that joined or left the cluster
GPU_PATIENCE = 10.0  # s to wait for a free GPU before workers use CPU cores
PROBE_PATIENCE = 120.0  # s to wait for a process that tries a GPU; it imports JAX
PATIENCE = 60.0  # s without any worker before the driver says why
STARTS = 3  # failed starts in a row after which a worker is given up
MAX_SILENT = 1800.0  # s without a report after which a worker is given up; a large program compiles for minutes


@dataclass(eq=False)
class WorkerHandle:
    """A worker as the driver sees it: its machine, and the state of its current process, if any."""

    node: str  # Ray's id of its machine
    host: str
    memory: int = 0  # bytes that Ray reserves for it
    actor: Any = None
    answer: Any = None  # reference to the pending result of `begin`, of `compile_next`, then of `work`
    up: bool = False  # `begin` has succeeded
    heard: int = 0  # rounds that have reached the driver
    out_of_reach: bool = False  # Ray could not reach it; `answer` now waits until it can
    failed_starts: int = 0  # in a row
    why: str = ""  # reason of the last failed start

    @property
    def starting(self) -> bool:
        return self.actor is not None and not self.up

    @property
    def free(self) -> bool:
        """Whether the worker can take an order now."""
        return self.up and self.answer is None

    def start(self, name: str, gpus: int, *begin: Any) -> None:
        """Start a worker. It gets no unit before `begin` answers, because its machine may never have room for it."""
        here = NodeAffinitySchedulingStrategy(self.node, soft=False)
        resources = {"num_cpus": 1, "num_gpus": gpus, "memory": self.memory}
        options = {"max_restarts": 0, "scheduling_strategy": here, **resources}
        self.actor = ray.remote(WorkerActor).options(name=f"{name} on {self.host}", **options).remote(is_canceled)
        self.answer = self.actor.begin.remote(*begin)

    def end(self) -> None:
        """Kill the worker, if it is alive, so that another can start in its place."""
        if self.actor is not None:
            ray.kill(self.actor)
        self.actor, self.answer, self.up, self.heard, self.out_of_reach = None, None, False, 0, False


def _reason(error: RayError) -> str:
    """Return Ray's reason for a worker's death, as a sentence without its full stop."""
    lines = str(error).strip().splitlines()
    if isinstance(error, ActorDiedError):
        return lines[-1] if error.actor_init_failed else "The worker died; if memory ran out, `dmesg` shows it"
    if isinstance(error, RayTaskError):  # the first line names the call, the last one the cause
        return f"The worker died: {last_line(error)}"
    return f"The worker died: {lines[0].rstrip('.')}"


def run(job: JobConfig, split: Path, scheduler: Scheduler, settle: Settle, board: Board, stop: Stop) -> None:
    """Run all units on Ray workers, or until a stop is requested.

    Raises:
        UserError: the cluster of RAY_ADDRESS cannot be reached.
        Failure: no worker can start.
        KeyboardInterrupt: a stop was requested; workers have committed the decided levels, as far as time allowed.
    """
    with connected(), stop.heeded():  # in this order: Ray sets a handler of its own when it starts
        crew = Crew(with_absolute_paths(job), absolute(split), scheduler, board, served(split))
        while not scheduler.over:
            crew.follow_cluster()
            crew.start_workers()
            crew.order()
            outcomes = crew.wait()
            try:
                settle(outcomes)
            except Exception:
                board.say("This job cannot continue: it ends once its workers have committed what they can.")
                with suppress(Exception):  # the first failure counts
                    settle(crew.leave(GRACE))
                raise
            board.refresh(working=bool(scheduler.workers))
            if stop.asked.is_set():
                board.say(STOPPING)
                settle(crew.leave(stop.grace))
                raise KeyboardInterrupt


class Crew:
    """All workers of a job: one for each core or GPU of each machine."""

    def __init__(self, job: JobConfig, split: Path, scheduler: Scheduler, board: Board, writer: str = "") -> None:
        """Plan the workers; `writer` names the writer for which they commit (see `leases.serve`), or is empty."""
        if why := _why_no_gpu() if job.device == "gpu" else "":
            board.say(f"Workers use CPU cores, not GPUs: {why}.")
        self._gpus = job.device == "gpu" and not why
        self._job = replace(job, device="gpu" if self._gpus else "cpu")
        self._split, self._scheduler, self._board, self._writer = split, scheduler, board, writer
        self._most = most_workers(job, scheduler.waiting)
        self._kind, self._memory = "GPU" if self._gpus else "CPU", bytes_of_worker(size_of(job.size))
        self._handles: list[WorkerHandle] = []
        self._refused: set[str] = set()  # machines with another program, or that do not see the split
        self._short: set[str] = set()  # machines whose lack of memory has been reported
        self._given_up: Counter[str] = Counter()  # number of workers that cannot start, by machine
        self._started = 0
        self._meters = Meters(split, Gauge) if ray_address() else None
        self._rescan_at = 0.0
        self._notice_at = time.monotonic() + PATIENCE

    def follow_cluster(self) -> None:
        """Adapt the number of workers to the room that the machines have now; a local cluster never changes."""
        if time.monotonic() < self._rescan_at:
            return
        self._rescan_at = time.monotonic() + RESCAN if ray_address() else float("inf")
        if self._meters:
            self._meters.show(self._board.tally)
        machines = {node: machine for node, machine in _machines().items() if node not in self._refused}
        room = workers_by_machine(machines, self._kind, self._most, self._memory)
        for handle in [handle for handle in self._handles if not handle.up]:
            if sum(other.node == handle.node for other in self._handles) > room[handle.node]:
                handle.end()
                self._handles.remove(handle)
        for node, count in room.items():
            there = sum(handle.node == node for handle in self._handles) + self._given_up[node]
            host, memory = machines[node]["NodeManagerHostname"], memory_to_reserve(machines[node], self._memory)
            self._handles += [WorkerHandle(node, host, memory) for _ in range(count - there)]
            if node not in self._short and (why := shortage(machines[node], self._kind, self._most, self._memory)):
                self._short.add(node)
                self._board.say(why)
        del self._handles[self._most :]

    def start_workers(self) -> None:
        """Start missing workers for about STARTING seconds, while more levels wait than workers are starting."""
        end = time.monotonic() + STARTING
        starting = sum(handle.starting for handle in self._handles)
        without = [handle for handle in self._handles if handle.actor is None]
        for handle in without[: max(0, self._scheduler.waiting - starting)]:
            if time.monotonic() > end:
                break
            self._started += 1
            name = f"levelproof {self._job.budget}/{self._job.size} worker {self._started}"
            neighbours = 0 if self._gpus else sum(other.node == handle.node for other in self._handles)
            begin = versions_of(self._job), self._job, self._split, neighbours, self._writer
            handle.start(name, int(self._gpus), *begin)

    def order(self) -> None:
        """Send an order to each worker that has reported, and let it continue."""
        self._scheduler.share()
        for handle in self._handles:
            if handle.free:
                order = self._scheduler.order(handle, time.monotonic())
                if self._scheduler.workers[handle].units:
                    handle.answer = handle.actor.work.remote(order, until_report(order, len(self._handles)))

    def wait(self) -> list[UnitOutcome]:
        """Wait up to POLL for rounds to end; return their outcomes."""
        pending = {handle.answer: handle for handle in self._handles if handle.answer is not None}
        self._notice_silence(any(handle.up for handle in self._handles))
        if not pending:
            time.sleep(POLL)
            return []
        outcomes = self._collect(pending, POLL)
        for handle in self._scheduler.silent(time.monotonic() - MAX_SILENT):
            outcomes += self._lose(handle, f"The worker on {handle.host} was silent for {duration(MAX_SILENT)}")
        self._give_up()
        return outcomes

    def leave(self, seconds: float) -> list[UnitOutcome]:
        """Cancel running rounds, let all workers commit what they can within `seconds`, and return the outcomes."""
        end = time.monotonic() + seconds
        for handle in self._handles:
            if handle.up:
                if handle.answer is not None:
                    ray.cancel(handle.answer)
                handle.answer = handle.actor.leave.remote(handle.heard)
        outcomes: list[UnitOutcome] = []
        while (last := {handle.answer: handle for handle in self._handles if handle.up}) and time.monotonic() < end:
            outcomes += self._collect(last, max(0.0, end - time.monotonic()))
        return outcomes

    def _collect(self, pending: Mapping[Any, WorkerHandle], seconds: float) -> list[UnitOutcome]:
        """Wait up to `seconds` for the first of these workers' answers; return the outcomes in all that are ready."""
        ray.wait([*pending], timeout=seconds)
        ready, _ = ray.wait([*pending], num_returns=len(pending), timeout=0)
        outcomes: list[UnitOutcome] = []
        for handle in (pending[reference] for reference in ready):
            if handle.answer is not None:  # None: it was ended when another worker's refusal ruled out its machine
                outcomes += self._hear(handle)
        return outcomes

    def _hear(self, handle: WorkerHandle) -> Sequence[UnitOutcome]:
        """Process a worker's answer; one that died or left is replaced by `start_workers`."""
        reference, handle.answer = handle.answer, None
        try:
            answer: Any = ray.get(reference)
        except ActorUnavailableError:  # Ray will soon know whether the worker died, and whether its machine did
            handle.answer, handle.out_of_reach = handle.actor.__ray_ready__.remote(), True
            return []
        except RayError as error:
            return self._lose(handle, f"{error}\n\n{_reason(error)}", _reason(error))
        if handle.out_of_reach:
            return self._lose(handle, "The worker was out of reach", "The worker was out of reach")
        if not handle.up:
            if isinstance(answer, tuple):
                self._board.tally.compiled, self._notice_at = answer, time.monotonic() + PATIENCE
                handle.answer = handle.actor.compile_next.remote()
                return []
            if answer:
                self._refuse(handle, answer)
                return []
            handle.up, handle.failed_starts = True, 0
            self._scheduler.join(handle, time.monotonic())
            return []
        rounds = answer if isinstance(answer, list) else [answer]  # `up` is False after the round in which it leaves
        return [outcome for round in rounds if handle.up for outcome in self._report(handle, round)]

    def _report(self, handle: WorkerHandle, round: Round) -> Sequence[UnitOutcome]:
        """Pass a round to the scheduler and the board; return its outcomes."""
        handle.heard += 1
        self._scheduler.report(handle, round, time.monotonic())
        self._board.follow(round)
        if round.leaves:
            self._scheduler.leave(handle)
            handle.end()
        return [each.on(handle.host) for each in round.outcomes] if ray_address() else round.outcomes

    def _lose(self, handle: WorkerHandle, reason: str, sentence: str = "") -> Sequence[UnitOutcome]:
        """Account for a worker's death; its units failed, unless its machine is lost as well."""
        was_up, machine_lost = handle.up, handle.node not in _machines()
        handle.end()
        if machine_lost:
            self._rescan_at = 0.0
        elif not was_up:
            handle.failed_starts, handle.why = handle.failed_starts + 1, sentence
        if was_up and machine_lost:
            units = self._scheduler.workers[handle].units
            self._board.say(f"{handle.host} is lost; others take over {levels_text(units) if units else 'its work'}.")
            self._hand_on(handle)
        return self._scheduler.lost(handle, reason) if was_up and not machine_lost else []

    def _hand_on(self, handle: WorkerHandle) -> None:
        """Return a lost worker's units to the scheduler."""
        self._board.tally.forget(self._scheduler.workers[handle].units)
        self._scheduler.leave(handle)

    def _refuse(self, handle: WorkerHandle, why: str) -> None:
        """Exclude a machine, because it has another program or does not see the split.

        Raises:
            LeaseLost: no machine can see the split, because another command has taken it over.
            Failure: no other worker is left.
        """
        require_served(self._split)
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
        """Give up workers that failed to start STARTS times.

        Raises:
            Failure: no other worker is left.
        """
        usable = [handle for handle in self._handles if handle.failed_starts < STARTS]
        for handle in self._handles:
            if not usable:
                raise Failure(f"No worker can start ({handle.why}): try executor=inline, which may show the cause.")
            if handle not in usable:
                self._given_up[handle.node] += 1
                self._board.say(f"A worker cannot start ({handle.why}) and is given up; {len(usable)} remain.")
        self._handles = usable

    def _notice_silence(self, working: bool) -> None:
        """Tell the user once if no worker has run for PATIENCE seconds."""
        if working:
            self._notice_at = time.monotonic() + PATIENCE
        elif time.monotonic() > self._notice_at:
            self._board.say("No worker is running: `ray status` shows which resources are free.")
            self._notice_at = float("inf")


@contextmanager
def _listening_on_loopback(alone: bool) -> Iterator[None]:
    """Have a Ray that starts in the `with` block listen on loopback if it is `alone`, else on the network."""
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = not alone
    try:
        yield
    finally:  # a later cluster of this process makes its own choice
        ray_constants.ENABLE_RAY_CLUSTER = before


@contextmanager
def connected() -> Iterator[None]:
    """Connect to the cluster of RAY_ADDRESS, or to a new one on this machine that lasts for the `with` block.

    Raises:
        UserError: there is no cluster at RAY_ADDRESS.
        Failure: Ray cannot start here.
    """
    if ray_address():
        require_reachable(ray_address())
        settings: dict[str, Any] = {}
    else:
        settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE, "num_cpus": len(own_cores())}
        settings["address"] = "local"  # ignore a local cluster that RAY_ADDRESS does not name
    # redirect_stdout, because Ray prints a long text on each worker's death
    with _listening_on_loopback(not ray_address()), redirect_stdout(io.StringIO()):
        try:
            with noticing_slow_starts(PATIENCE):
                ray.init(log_to_driver=False, logging_level=logging.FATAL, **settings)
        except Exception as error:
            if known := cannot_start(error):
                raise known from error
            raise
        try:
            yield
        finally:
            ray.shutdown()


def _why_no_gpu() -> str:
    """Return why workers cannot have GPUs; empty if the cluster has a free one that JAX can use."""
    if not ray.cluster_resources().get("GPU"):
        return "the cluster has none"
    group = placement_group([{"GPU": 1}])
    try:
        if not group.wait(GPU_PATIENCE):
            return f"all of them were still in use after {duration(GPU_PATIENCE)}"
        strategy = PlacementGroupSchedulingStrategy(group)
        probe = ray.remote(num_cpus=0, num_gpus=1, max_calls=1, scheduling_strategy=strategy)(jax_sees_a_gpu)
        return "" if ray.get(probe.remote(), timeout=PROBE_PATIENCE) else NO_GPU
    except RayError as error:  # also after the time-out
        return f"the cluster has one, but no answer came from it ({last_line(error)})"
    finally:
        remove_placement_group(group)


def is_canceled() -> bool:
    """Whether the driver has cancelled the call that this worker executes."""
    return ray.get_runtime_context().is_canceled()


def _machines() -> dict[str, dict[str, Any]]:
    """Return the cluster's live machines by Ray's node ids."""
    return {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
