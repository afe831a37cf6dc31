"""A rehearsal of a job of millions of levels on thousands of workers: the real scheduler under a simulated clock.

Levels take as long as levels of a real run did. Machines die, or are taken away with notice, and are replaced; workers
crash; some are slow. The driver handles one report at a time, and a worker waits for its turn. The rehearsal counts
levels, lost work, reports, requests to the store, and the driver's time and memory.
"""

import argparse
import time
import tracemalloc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from benchmarks.report import Report, Table
from benchmarks.simulated import SimulatedWorker, Work
from levelproof.configs.compose import compose_job
from levelproof.configs.numbers import parse_count
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.plan import costs_of, measure
from levelproof.pipeline.jobs.schedule import Round, Scheduler, schedule, until_report
from levelproof.pipeline.jobs.sizing import MAX_FACTOR

UNTIMED, SLOTS = 32, 4  # levels of the first units, before any are timed; slots of size s on a core
HEARING = 1e-3  # s that the driver spends per report besides the scheduler's, on Ray's call and response; assumed
PUTS = 3500  # requests/s to one prefix of S3, from its documentation
REQUESTS = 13  # per unit of density full: a shard of 11 files, its mark, its fragment
POLL = 1.0  # s between offers to idle workers
REPLACEMENT = 300.0  # s until another machine replaces one that left


@dataclass(frozen=True)
class Scene:
    """Settings of a rehearsal."""

    name: str
    levels: int
    workers: int
    a_machine: int  # workers per machine
    speed: float = 1.0  # of a worker, relative to the core that the sample was timed on
    stretch: float = 1.0  # factor on the seconds of every level
    lifetime: float = 24 * 3600.0  # s, mean life of a machine until it is taken away with notice
    failures: float = 30 * 24 * 3600.0  # s, mean life of a machine until it dies without notice
    crashes: float = 7 * 24 * 3600.0  # s, mean life of a worker until its process dies
    slow: float = 0.01  # share of workers that are slow
    slower: float = 5.0  # factor by which they are slower
    unit: int | None = None  # levels per work unit; None: by the rule of `generate`


@dataclass
class Counts:
    """Totals of a rehearsal."""

    seconds: float = 0.0  # by the simulated clock
    levels: int = 0
    there: float = 0.0  # worker-seconds, from joining to leaving
    useful: float = 0.0  # worker-seconds spent on committed levels
    lost: float = 0.0  # worker-seconds spent on levels that were not committed
    reports: int = 0
    commits: int = 0
    scheduling: float = 0.0  # s of this process, in the scheduler
    hearing: float = 0.0  # s of the simulated driver
    quarantined: int = 0
    gone: int = 0  # machines that were taken away or failed


class Rehearsal:
    """Event loop of one scene."""

    def __init__(self, scene: Scene, seconds: Float[np.ndarray, " level"], seed: int = 0) -> None:
        self.scene, self.counts = scene, Counts()
        self._work, self._rng = Work(seconds * scene.stretch), np.random.default_rng(seed)
        self._scheduler = scheduler_of(scene)
        self._events: list[tuple[float, int, str, Any]] = []
        self._number, self._driver_free, self._idle = count(), 0.0, set[SimulatedWorker]()
        self._machines: dict[int, list[SimulatedWorker]] = {}
        for machine in range(-(-scene.workers // scene.a_machine)):
            self._at(self._rng.uniform(0, 60), "join", machine)
        self._at(POLL, "poll", None)

    def run(self) -> Counts:
        handle = {"join": self._join, "report": self._report, "poll": self._poll, "crash": self._crash}
        while not (self._machines and self._scheduler.over):
            self.counts.seconds, _, kind, payload = heappop(self._events)
            if kind in ("preempted", "dies"):
                self._remove_machine(*payload, notice=kind == "preempted")
            else:
                handle[kind](payload)
        left = (worker for workers in self._machines.values() for worker in workers)
        self.counts.there += sum(self.counts.seconds - worker.joined for worker in left)
        self.counts.quarantined = len(self._scheduler.quarantined)
        return self.counts

    def _at(self, when: float, kind: str, payload: Any) -> None:
        heappush(self._events, (when, next(self._number), kind, payload))

    def _scheduled(self, work: Any, *arguments: Any) -> Any:
        """Call the scheduler; add the time it takes on this machine."""
        start = time.perf_counter()
        answer = work(*arguments)
        self.counts.scheduling += time.perf_counter() - start
        return answer

    def _join(self, machine: int) -> None:
        scene, now = self.scene, self.counts.seconds
        count = min(scene.a_machine, scene.workers - machine * scene.a_machine)
        speeds = scene.speed / np.where(self._rng.random(count) < scene.slow, scene.slower, 1.0)
        slots = max(SLOTS, round(SLOTS * scene.speed))
        self._machines[machine] = [SimulatedWorker(machine, float(speed), slots, now) for speed in speeds]
        for worker in self._machines[machine]:
            self._scheduled(self._scheduler.join, worker, now)
            self._at(now + self._rng.exponential(scene.crashes), "crash", worker)
            self._order(worker)
        workers = self._machines[machine]
        self._at(now + self._rng.exponential(scene.lifetime), "preempted", (machine, workers))
        self._at(now + self._rng.exponential(scene.failures), "dies", (machine, workers))

    def _order(self, worker: SimulatedWorker) -> None:
        """Send a worker its order, as soon as the driver is free."""
        now = max(self._driver_free, self.counts.seconds) + HEARING
        order = self._scheduled(self._scheduler.order, worker, now)
        if not self._scheduler.workers[worker].units:
            self._idle.add(worker)
            return
        self._driver_free = now
        self.counts.hearing += HEARING
        self._idle.discard(worker)
        seconds = until_report(order, len(self._scheduler.workers))
        self._at(worker.begin(order, now, seconds, self._work), "report", (worker, worker.until))

    def _report(self, payload: tuple[SimulatedWorker, float]) -> None:
        worker, until = payload
        if worker.alive and worker.until == until:
            self._heard(worker, *worker.report(self.counts.seconds))
            self._order(worker)

    def _heard(self, worker: SimulatedWorker, round: Round, useful: float) -> None:
        self.counts.reports += 1
        self.counts.useful += useful
        self.counts.commits += len(round.outcomes)
        self.counts.levels += sum(len(outcome.unit.level_ids) for outcome in round.outcomes)
        self._scheduled(self._scheduler.report, worker, round, self.counts.seconds)

    def _poll(self, _: None) -> None:
        """Redistribute levels, and give idle workers their orders."""
        if self._idle:
            self._scheduled(self._scheduler.share)
            for worker in [*self._idle]:
                if not self._scheduler.waiting:
                    break
                self._order(worker)
        self._at(self.counts.seconds + POLL, "poll", None)

    def _crash(self, worker: SimulatedWorker) -> None:
        """Kill a process: its units count as failed, and another process replaces it."""
        if not worker.alive:
            return
        self._remove(worker)
        for outcome in self._scheduled(self._scheduler.lost, worker, "crashed"):
            self._scheduled(self._scheduler.failed, outcome.unit)
        other = SimulatedWorker(worker.machine, worker.speed, worker.slots, self.counts.seconds)
        self._machines[worker.machine].append(other)
        self._scheduled(self._scheduler.join, other, self.counts.seconds)
        self._at(self.counts.seconds + self._rng.exponential(self.scene.crashes), "crash", other)
        self._order(other)

    def _remove_machine(self, machine: int, workers: list[SimulatedWorker], notice: bool) -> None:
        """Remove a machine, which leaves with notice or dies, and schedule its replacement."""
        if self._machines.get(machine) is not workers:
            return
        self.counts.gone += 1
        for worker in [*workers]:
            if notice:
                self._heard(worker, *worker.leave(self.counts.seconds))
                worker.units.clear()
            self._remove(worker)
            self._scheduled(self._scheduler.leave, worker)
        del self._machines[machine]
        self._at(self.counts.seconds + REPLACEMENT, "join", machine)

    def _remove(self, worker: SimulatedWorker) -> None:
        worker.alive = False
        self._idle.discard(worker)
        self._machines[worker.machine].remove(worker)
        self.counts.there += self.counts.seconds - worker.joined
        done = (self.counts.seconds - worker.since) * worker.speed if worker.units else 0.0
        self.counts.lost += max(worker.into + done, 0.0)


def scheduler_of(scene: Scene) -> Scheduler:
    """Return the scheduler of `generate` with all levels of a scene planned."""
    return schedule(range(scene.levels), (), scene.levels, scene.unit or UNTIMED, scene.unit is None)


def state_bytes(scene: Scene) -> int:
    """Return the peak memory of the driver's plan and scheduler until every worker is busy, bytes."""
    tracemalloc.start()
    scheduler = scheduler_of(scene)
    for worker in range(scene.workers):
        scheduler.join(worker, 0.0)
        scheduler.order(worker, 0.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", default=["size=s", "budget=64k"], help="settings of the levels to time")
    parser.add_argument("--split", type=Path, help="a split whose rows have seconds (default: time new levels)")
    parser.add_argument("--mean", type=float, metavar="S", help="mean seconds of a level (default: as measured)")
    parser.add_argument("--levels", default="11.5M", help="levels of the rehearsed job (default: 11.5M)")
    parser.add_argument(
        "--workers", type=int, default=10_000, metavar="N", help="cores (default: 10000); a tenth as many GPUs"
    )


def run(args: argparse.Namespace) -> Report:
    busy, levels = _measured(args), parse_count(args.levels, "levels")
    seconds = busy * (args.mean / busy.mean()) if args.mean else busy
    scaled = ", scaled to that average" if args.mean else ""
    gpus = max(1, args.workers // 10)
    scenes = [
        Scene(f"{args.workers:,} cores", levels, args.workers, 64),
        Scene(f"{args.workers:,} cores, levels 16 times as long", levels, args.workers, 64, stretch=16.0),
        Scene("the same, machines that live an hour", levels, args.workers, 64, stretch=16.0, lifetime=3600.0),
        Scene(f"{gpus:,} GPUs of 20 cores each", levels, gpus, 8, speed=20.0, stretch=16.0),
    ]
    results = [rehearsed(scene, seconds) for scene in scenes]
    peak = state_bytes(scenes[0])
    head = (
        "",
        "hours",
        "levels/s",
        "levels a unit",
        "busy",
        "lost",
        "machines gone",
        "reports/s",
        "scheduler",
        "driver",
        "writes/s",
        "first",
    )
    return Report(
        title="A rehearsal at scale",
        results=[*results, {"state_bytes": peak}],
        tables=[Table(head, [row(result) for result in results])],
        notes=[
            f"{levels:,} levels, by the scheduler of `generate` under a simulated clock, in units of its default size: "
            f"20 to 60 s of a worker, at most {MAX_FACTOR * UNTIMED} levels and a quarter of a worker's share; a "
            f"level takes the time of one of {len(seconds):,} measured levels, {seconds.mean():.3g} core-seconds on "
            f"average{scaled}. On average, a machine of 64 cores or 8 GPUs is taken away with notice after a day, or "
            f"as named, and dies without notice after 30 days; another replaces it {REPLACEMENT / 60:.0f} minutes "
            "later. Processes crash once a week; 1% of workers are five times slower. That a GPU equals 20 "
            "cores is assumed, not measured.",
            "*levels a unit*: on average. *busy*: share of the workers' time, from joining to leaving, that went into "
            "committed levels; *lost*: share of their work that did not. "
            "*scheduler*: microseconds of this machine per report; *driver*: share of its time, with "
            f"{HEARING * 1e3:.0f} ms for Ray's part of a report, which is assumed. *writes/s*: requests to an object "
            f"store, {REQUESTS} per unit; S3 promises {PUTS:,} a second per prefix. *first*: the most loaded of store, "
            "driver and workers, and its load; above 100% it cannot keep up, and the job takes longer than shown.",
            "Sealing is left out. One thread of the driver seals, and no worker waits for it; what is still due after "
            "the last commit is sealed then, which adds to these hours. Measured by hand, on a core shared with other "
            "work: 128 units of 16 levels in 21 to 26 s, through a server on the same core that answers after 30 ms. A "
            f"job that commits more units a second than that (*writes/s* divided by {REQUESTS}) ends with a backlog.",
            f"The plan and the scheduler take {peak / 2**20:.0f} MiB of the driver's memory with all workers busy.",
        ],
    )


def _measured(args: argparse.Namespace) -> Float[np.ndarray, " level"]:
    if not args.split:
        return measure(compose_job([*args.settings, "levels=4k"]), Console(stderr=True)).busy
    _, busy, _ = costs_of(args.split)
    if not np.isfinite(busy).all():
        raise UserError(f"Rows of {args.split} have no seconds: give a split that this version made.")
    return busy


def rehearsed(scene: Scene, seconds: Float[np.ndarray, " level"]) -> dict[str, Any]:
    """Run a scene; return its results as a JSON document."""
    counts = Rehearsal(scene, seconds).run()
    writes = counts.commits * REQUESTS / counts.seconds
    loads = {
        "driver": (counts.hearing + counts.scheduling) / counts.seconds,
        "store": writes / PUTS,
        "workers": counts.useful / (counts.there * scene.speed),
    }
    return {
        "scene": scene.name,
        "hours": counts.seconds / 3600,
        "levels": counts.levels,
        "levels_per_second": counts.levels / counts.seconds,
        "levels_per_unit": counts.levels / counts.commits,
        "busy": loads["workers"],
        "lost": counts.lost / (counts.useful + counts.lost),
        "machines_gone": counts.gone,
        "quarantined": counts.quarantined,
        "reports_per_second": counts.reports / counts.seconds,
        "scheduler_us": counts.scheduling / max(counts.reports, 1) * 1e6,
        "driver": loads["driver"],
        "writes_per_second": writes,
        "first": (first := max(loads, key=lambda name: loads[name])),
        "load": loads[first],
    }


def row(result: Mapping[str, Any]) -> Sequence[str]:
    return [
        result["scene"],
        f"{result['hours']:.2f}",
        f"{result['levels_per_second']:,.0f}",
        f"{result['levels_per_unit']:,.0f}",
        f"{result['busy']:.0%}",
        f"{result['lost']:.2%}",
        f"{result['machines_gone']:,}",
        f"{result['reports_per_second']:,.0f}",
        f"{result['scheduler_us']:.0f} µs",
        f"{result['driver']:.0%}",
        f"{result['writes_per_second']:,.0f}",
        f"{result['first']}, {result['load']:.0%}",
    ]
