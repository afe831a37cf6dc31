"""Training for the benchmark `solved`: one pinned process per core, and a line per level."""

import hashlib
import json
import math
import multiprocessing
import queue
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.solved.results import FILE, OF_LEVEL, Header, Results, merge, read
from benchmarks.solved.variants import Variant
from levelproof.experts.labels import Label, Verdict
from levelproof.experts.steps import Totals
from levelproof.pipeline.errors import Failure, LevelproofError, UserError
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Summary, WorkUnit, plan_units
from levelproof.pipeline.runtime import cache_folder, own_cores, prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.provenance import device, versions

UNIT = 32  # levels, as in a job
POLL = 0.5  # s between checks of the processes
DIGITS = 4  # decimal places of numbers in a file


@dataclass(frozen=True)
class Progress:
    """A process's progress on a unit."""

    unit: WorkUnit
    totals: Totals


@dataclass(frozen=True)
class Trained:
    """A finished unit."""

    unit: WorkUnit
    rows: list[dict[str, Any]]
    summary: Summary
    versions: dict[str, Any]
    device: str


def measure(
    header: Header,
    variant: Variant,
    level_ids: range,
    jobs: int,
    worker: Callable[..., None],
    replace: bool = False,
    file: Path = FILE,
) -> None:
    """Train levels without a result. The cache folder keeps finished units until the run is complete.

    Args:
        header: variant, size, budget and settings of the levels.
        variant: how to train.
        level_ids: levels that need a result.
        jobs: number of processes; 0: one per core.
        worker: what each process runs, such as `work`.
        replace: whether to delete results from other settings.
        file: the results.

    Raises:
        UserError: results are from other settings, or there are more jobs than cores.
        LevelproofError: a process failed or died.
    """
    known = {results.header.name: results for results in read(file)}.get(header.name, Results(header, {}))
    if known.header != header and not replace:
        raise UserError(f"{header.name} has results from other settings: pass --again to replace them.")
    scratch = scratch_of(header)
    existing = (known.rows if known.header == header else {}) | rows_in(scratch)
    train_all(header, variant, level_ids, existing, jobs, worker, scratch)
    if rows := rows_in(scratch):
        merge(Results(header, rows), file)
        scratch.unlink()


def train_all(
    header: Header,
    variant: Variant,
    level_ids: range,
    existing: Mapping[int, Mapping[str, Any]],
    jobs: int,
    worker: Callable[..., None],
    scratch: Path,
) -> None:
    """Train levels not in `existing`, in processes; append a unit's lines to `scratch` when it is done."""
    units = list(plan_units(level_ids, existing, UNIT))
    cores = own_cores()
    if not 0 <= jobs <= len(cores):
        raise UserError(f"--jobs is {jobs}: this process may use {len(cores)} cores; give at most that many.")
    done = [existing[level_id] for level_id in level_ids if level_id in existing]
    solved = sum(row["label"] == Label.SOLVED for row in done)
    board = Board(Tally(len(level_ids), len(done), solved), Console(stderr=True))
    context = multiprocessing.get_context("spawn")
    tasks, messages = context.Queue(), context.Queue()
    processes = [
        context.Process(target=worker, args=(core, header, variant, tasks, messages), daemon=True)
        for core in cores[: min(jobs or len(cores), len(units))]
    ]
    for task in (*units, *[None] * len(processes)):
        tasks.put(task)
    try:
        with stoppable(), board.shown():
            for process in processes:
                process.start()
            follow(len(units), messages, processes, board, scratch)
    finally:
        for process in processes:
            if process.is_alive():
                process.terminate()


def follow(units: int, messages: Any, processes: list, board: Board, scratch: Path) -> None:
    """Store and show what processes report, until all units are done.

    Raises:
        LevelproofError: a process failed or died.
    """
    while units:
        board.refresh()
        try:
            message = messages.get(timeout=POLL)
        except queue.Empty:
            if any(process.exitcode for process in processes):
                raise Failure("A process died: run the same command again to resume.") from None
            continue
        if isinstance(message, LevelproofError):
            raise message
        if isinstance(message, Trained):
            append(scratch, message)
            board.ended(message.unit, message.summary)
            units -= 1
        else:
            board.tally.running[message.unit] = message.totals


def scratch_of(header: Header) -> Path:
    """Return the file that keeps a run's lines until it is complete; every configuration has its own."""
    settings = hashlib.sha256(json.dumps(header.config, sort_keys=True).encode()).hexdigest()[:12]
    return cache_folder() / "solved" / f"{header.name}-{settings}.jsonl"


def append(scratch: Path, trained: Trained) -> None:
    """Append a unit's lines."""
    run = {"versions": json.dumps(trained.versions), "device": trained.device, "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    scratch.parent.mkdir(parents=True, exist_ok=True)
    with scratch.open("a") as file:
        file.write("".join(json.dumps(row | run) + "\n" for row in trained.rows))


def rows_in(scratch: Path) -> dict[int, dict[str, Any]]:
    """Read rows by level id; remove an incomplete last line from the file."""
    if not scratch.exists():
        return {}
    whole, newline, _ = scratch.read_bytes().rpartition(b"\n")
    scratch.write_bytes(whole + newline)
    rows = [json.loads(line) for line in whole.splitlines()]
    return {row.pop("level_id"): row for row in rows}


def work(core: int, header: Header, variant: Variant, tasks: Any, messages: Any) -> None:
    """Train units until none is left. Core-seconds exclude compiling, and slots that are empty at the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the main process ends the others
    prepare_jax(core)
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.alone import side_by_side
    from levelproof.experts.pool.pool import Pool
    from levelproof.experts.pool.run import TrainingRun
    from levelproof.levelgen.level import Level, size_of
    from levelproof.levelgen.sampling.distribution import Distribution
    from levelproof.levelgen.sampling.sampler import sample_levels
    from levelproof.levelgen.task.rules import DEFAULT_RULES

    pools = lambda budget: Pool(budget, variant.procedure, DEFAULT_RULES)
    reported_at = time.monotonic()

    def sampled(units: Iterable[WorkUnit]) -> Iterator[tuple[WorkUnit, Level, np.ndarray]]:
        for unit in units:
            ids = np.asarray(unit.level_ids, np.int32)
            yield unit, sample_levels(jnp.asarray(ids), size_of(header.size), Distribution()), ids

    def report(runs: Mapping[WorkUnit, TrainingRun]) -> None:
        nonlocal reported_at
        if time.monotonic() - reported_at > POLL:
            reported_at = time.monotonic()
            for unit, run in runs.items():
                messages.put(Progress(unit, run.totals()))

    first = tasks.get()  # there is a unit for each process
    deque(side_by_side(pools(variant.procedure.expert.steps_per_update), sampled([first])), maxlen=0)
    units = sampled(chain([first], iter(tasks.get, None)))
    for unit, result in side_by_side(pools(header.budget), units, report):
        rows = []
        for i, (level_id, verdict) in enumerate(zip(result.level_ids.tolist(), result.verdicts, strict=True)):
            assert result.ledger is not None
            cost = result.ledger.seconds_of(i)
            rows.append(row_of(level_id, verdict, sum(cost) - cost.idle - cost.compiling))
        solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
        messages.put(Trained(unit, rows, Summary(len(rows), solved, result.spent), versions(), device()))


def row_of(level_id: int, verdict: Verdict, seconds: float) -> dict[str, Any]:
    """Make a level's line."""
    values = {name: getattr(verdict, name) for name in OF_LEVEL if name != "core_seconds"}
    return {"level_id": level_id} | {name: short(x) for name, x in (values | {"core_seconds": seconds}).items()}


def short(value: Any) -> Any:
    """Round a float for JSON; NaN becomes null."""
    if not isinstance(value, float):
        return value
    return None if math.isnan(value) else round(value, DIGITS)
