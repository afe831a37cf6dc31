"""A job of millions of levels on thousands of workers, rehearsed: the scheduler is the real one, the clock is not.

Levels take as long as levels of a real run did. Machines die without a word or are taken away with notice, and come
back; workers crash; some are slow. The driver hears one report at a time, and a worker waits until it is heard. What is
counted: levels, work that was lost, reports, requests to the store, what the driver computes and keeps in memory.
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

UNTIMED, SLOTS = 32, 4  # levels of a unit that nobody has timed, experts side by side: of size s on a core
HEARING = 1e-3  # s of the driver for a report beside the scheduler's: Ray's call and its answer; assumed
PUTS = 3500  # a second to one prefix of S3, as its documentation says
REQUESTS = 13  # to write for a unit of density full: a shard of 11 files, its mark, its fragment
LOOK = 1.0  # s between two looks at workers that have nothing
AWAY = 300.0  # s after which another machine takes the place of one that is gone


@dataclass(frozen=True)
class Scene:
    """What is rehearsed."""

    name: str
    levels: int
    workers: int
    a_machine: int  # workers
    speed: float = 1.0  # of a worker, against the core of the sample
    stretch: float = 1.0  # of what a level takes
    lifetime: float = 24 * 3600.0  # s of a machine on average, until it is taken away with notice
    failures: float = 30 * 24 * 3600.0  # s of a machine on average, until it dies without
    crashes: float = 7 * 24 * 3600.0  # s of a worker on average, until its process dies
    slow: float = 0.01  # share of workers
    slower: float = 5.0  # times
    unit: int | None = None  # levels per work unit; None: by the rule of `generate`


@dataclass
class Counts:
    """What came of it."""

    seconds: float = 0.0  # by the simulated clock
    levels: int = 0
    there: float = 0.0  # s of workers, from when they join to when they go
    useful: float = 0.0  # s of workers, on what was committed
    lost: float = 0.0  # s of workers, on what was not
    reports: int = 0
    commits: int = 0
    scheduling: float = 0.0  # s of this process, in the scheduler
    hearing: float = 0.0  # s of the simulated driver
    quarantined: int = 0
    gone: int = 0  # machines


class Rehearsal:
    """One scene, event after event."""

    def __init__(self, scene: Scene, seconds: Float[np.ndarray, " level"], seed: int = 0) -> None:
        self.scene, self.counts = scene, Counts()
        self._work, self._rng = Work(seconds * scene.stretch), np.random.default_rng(seed)
        self._scheduler = scheduler_of(scene)
        self._events: list[tuple[float, int, str, Any]] = []
        self._number, self._driver_free, self._idle = count(), 0.0, set[SimulatedWorker]()
        self._machines: dict[int, list[SimulatedWorker]] = {}
        for machine in range(-(-scene.workers // scene.a_machine)):
            self._at(self._rng.uniform(0, 60), "join", machine)
        self._at(LOOK, "look", None)

    def run(self) -> Counts:
        handle = {"join": self._join, "report": self._report, "look": self._look, "crash": self._crash}
        while not (self._machines and self._scheduler.over):
            self.counts.seconds, _, kind, what = heappop(self._events)
            if kind in ("preempted", "dies"):
                self._goes(*what, notice=kind == "preempted")
            else:
                handle[kind](what)
        left = (worker for workers in self._machines.values() for worker in workers)
        self.counts.there += sum(self.counts.seconds - worker.joined for worker in left)
        self.counts.quarantined = len(self._scheduler.quarantined)
        return self.counts

    def _at(self, when: float, kind: str, what: Any) -> None:
        heappush(self._events, (when, next(self._number), kind, what))

    def _scheduled(self, work: Any, *words: Any) -> Any:
        """A call of the scheduler, by this machine's clock."""
        begun = time.perf_counter()
        answer = work(*words)
        self.counts.scheduling += time.perf_counter() - begun
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
        """The driver tells a worker what to do, when it comes to it."""
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

    def _report(self, what: tuple[SimulatedWorker, float]) -> None:
        worker, until = what
        if worker.alive and worker.until == until:
            self._heard(worker, *worker.report(self.counts.seconds))
            self._order(worker)

    def _heard(self, worker: SimulatedWorker, round: Round, useful: float) -> None:
        self.counts.reports += 1
        self.counts.useful += useful
        self.counts.commits += len(round.outcomes)
        self.counts.levels += sum(len(of.unit.level_ids) for of in round.outcomes)
        self._scheduled(self._scheduler.report, worker, round, self.counts.seconds)

    def _look(self, _: None) -> None:
        """Workers that have nothing are offered what there is by now."""
        if self._idle:
            self._scheduled(self._scheduler.share)
            for worker in [*self._idle]:
                if not self._scheduler.waiting:
                    break
                self._order(worker)
        self._at(self.counts.seconds + LOOK, "look", None)

    def _crash(self, worker: SimulatedWorker) -> None:
        """The process dies; another takes its place, and its units count as failed."""
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

    def _goes(self, machine: int, workers: list[SimulatedWorker], notice: bool) -> None:
        """A machine is taken away, or dies; another comes."""
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
        self._at(self.counts.seconds + AWAY, "join", machine)

    def _remove(self, worker: SimulatedWorker) -> None:
        worker.alive = False
        self._idle.discard(worker)
        self._machines[worker.machine].remove(worker)
        self.counts.there += self.counts.seconds - worker.joined
        done = (self.counts.seconds - worker.since) * worker.speed if worker.units else 0.0
        self.counts.lost += max(worker.into + done, 0.0)


def scheduler_of(scene: Scene) -> Scheduler:
    """The scheduler of `generate`, with all levels of a scene to do."""
    return schedule(range(scene.levels), (), scene.levels, scene.unit or UNTIMED, scene.unit is None)


def state_bytes(scene: Scene) -> int:
    """Memory that the driver's plan and scheduler take until every worker is busy, at most."""
    tracemalloc.start()
    scheduler = scheduler_of(scene)
    for worker in range(scene.workers):
        scheduler.join(worker, 0.0)
        scheduler.order(worker, 0.0)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", default=["size=s", "budget=64k"], help="of the levels that are measured")
    parser.add_argument("--split", type=Path, help="a split whose rows tell seconds (default: some levels are made)")
    parser.add_argument(
        "--mean", type=float, metavar="S", help="s that a level takes on average (default: as measured)"
    )
    parser.add_argument("--levels", default="11.5M", help="of the rehearsed job (default: 11.5M)")
    parser.add_argument("--workers", type=int, default=10_000, metavar="N", help="cores; GPUs are a tenth of them")


def run(args: argparse.Namespace) -> Report:
    found, levels = _measured(args), parse_count(args.levels, "levels")
    seconds = found * (args.mean / found.mean()) if args.mean else found
    scaled = ", scaled to that average" if args.mean else ""
    gpus = max(1, args.workers // 10)
    scenes = [
        Scene(f"{args.workers:,} cores", levels, args.workers, 64),
        Scene(f"{args.workers:,} cores, levels 16 times as long", levels, args.workers, 64, stretch=16.0),
        Scene("the same, machines that live an hour", levels, args.workers, 64, stretch=16.0, lifetime=3600.0),
        Scene(f"{gpus:,} GPUs of 20 cores each", levels, gpus, 8, speed=20.0, stretch=16.0),
    ]
    results = [rehearsed(scene, seconds) for scene in scenes]
    most = state_bytes(scenes[0])
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
        results=[*results, {"state_bytes": most}],
        tables=[Table(head, [row(of) for of in results])],
        notes=[
            f"{levels:,} levels, by the scheduler of `generate` under a simulated clock, in units of its default size: "
            f"20 to 60 s of a worker, at most {MAX_FACTOR * UNTIMED} levels and a quarter of a worker's share; a "
            f"level takes what one of {len(seconds):,} measured ones did, {seconds.mean():.3g} core-seconds on average"
            f"{scaled}. Machines of 64 cores or 8 GPUs are taken away with notice after a day, or as said, and die "
            f"without after 30 days, on average, and another comes {AWAY / 60:.0f} minutes later; processes crash once "
            "a week; 1% of workers are five times slower. That a GPU is worth 20 cores is assumed, not measured.",
            "*levels a unit*: on average. *busy*: share of the workers' time, from when they join to when they go, "
            "that went into what was committed; *lost*: into what was not. "
            "*scheduler*: microseconds of this machine for each report; *driver*: share of its time, with "
            f"{HEARING * 1e3:.0f} ms for Ray's part of a report, which is assumed. *writes/s*: requests to an object "
            f"store, {REQUESTS} a unit; S3 promises {PUTS:,} a second to a prefix. *first*: the most loaded of store, "
            "driver and workers, and its load; above 100% it does not keep up, and the job takes longer than shown.",
            f"The plan and the scheduler take {most / 2**20:.0f} MB of the driver's memory with all workers busy.",
        ],
    )


def _measured(args: argparse.Namespace) -> Float[np.ndarray, " level"]:
    if not args.split:
        return measure(compose_job([*args.settings, "levels=4k"]), Console(stderr=True)).busy
    _, busy, _ = costs_of(args.split)
    if not np.isfinite(busy).all():
        raise UserError(f"Rows of {args.split} do not tell seconds: give a split that this version made.")
    return busy


def rehearsed(scene: Scene, seconds: Float[np.ndarray, " level"]) -> dict[str, Any]:
    """A scene in numbers."""
    of = Rehearsal(scene, seconds).run()
    writes = of.commits * REQUESTS / of.seconds
    loads = {
        "driver": (of.hearing + of.scheduling) / of.seconds,
        "store": writes / PUTS,
        "workers": of.useful / (of.there * scene.speed),
    }
    return {
        "scene": scene.name,
        "hours": of.seconds / 3600,
        "levels": of.levels,
        "levels_per_second": of.levels / of.seconds,
        "levels_per_unit": of.levels / of.commits,
        "busy": loads["workers"],
        "lost": of.lost / (of.useful + of.lost),
        "machines_gone": of.gone,
        "quarantined": of.quarantined,
        "reports_per_second": of.reports / of.seconds,
        "scheduler_us": of.scheduling / max(of.reports, 1) * 1e6,
        "driver": loads["driver"],
        "writes_per_second": writes,
        "first": (first := max(loads, key=lambda name: loads[name])),
        "load": loads[first],
    }


def row(of: Mapping[str, Any]) -> Sequence[str]:
    return [
        of["scene"],
        f"{of['hours']:.2f}",
        f"{of['levels_per_second']:,.0f}",
        f"{of['levels_per_unit']:,.0f}",
        f"{of['busy']:.0%}",
        f"{of['lost']:.2%}",
        f"{of['machines_gone']:,}",
        f"{of['reports_per_second']:,.0f}",
        f"{of['scheduler_us']:.0f} µs",
        f"{of['driver']:.0%}",
        f"{of['writes_per_second']:,.0f}",
        f"{of['first']}, {of['load']:.0%}",
    ]
