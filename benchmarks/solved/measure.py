"""Training the levels of a benchmark: one process per core, each pinned, and a line per level in a file."""

import json
import math
import multiprocessing
import queue
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.solved.results import Header, header_of, read
from benchmarks.solved.variants import Variant
from experts.labels import Label, Verdict
from pipeline.errors import Failure, LevelproofError, UserError
from pipeline.jobs.progress import Board, Tally
from pipeline.jobs.schedule import Summary, WorkUnit, plan_units
from pipeline.runtime import interruptible, own_cores, prepare_jax
from pipeline.store.provenance import device, versions

UNIT = 32  # levels that a process trains at a time
POLL = 0.5  # s between looks at the processes
DIGITS = 4  # of a share or of seconds in a file
FIELDS = (
    "label", "witness", "env_steps", "steps_to_first_success", "success_rate", "most_probable_succeeds",
    "sticky_success_rate", "moved_success_rate", "steps_to_goal", "episodes",
)  # fmt: skip


@dataclass(frozen=True)
class Progress:
    """How far a process is with a unit."""

    unit: WorkUnit
    totals: tuple[int, float, int]  # env steps, levels, solved levels


@dataclass(frozen=True)
class Trained:
    """A unit that is done."""

    unit: WorkUnit
    rows: list[dict[str, Any]]
    summary: Summary
    versions: dict[str, Any]
    device: str


def measure(header: Header, variant: Variant, wanted: range, out: Path, jobs: int, worker: Callable[..., None]) -> None:
    """Train the wanted levels that are not in the file; append each unit when it is done.

    Args:
        header: of the file.
        variant: how to train.
        wanted: level ids.
        out: the file.
        jobs: processes; 0: one per core.
        worker: what each does, as `work`.

    Raises:
        UserError: the file is of another benchmark, or there are not as many cores as jobs.
        LevelproofError: what a process tells, or that it died.
    """
    there = rows_there(out, header)
    units = plan_units(wanted, there, UNIT)
    cores = own_cores()
    if not 0 <= jobs <= len(cores):
        raise UserError(f"--jobs is {jobs}: this process may use {len(cores)} cores; give at most that many.")
    done = [there[level_id] for level_id in wanted if level_id in there]
    solved = sum(row["label"] == Label.SOLVED for row in done)
    board = Board(Tally(len(wanted), len(done), solved), Console(stderr=True))
    context = multiprocessing.get_context("spawn")
    tasks, told = context.Queue(), context.Queue()
    processes = [
        context.Process(target=worker, args=(core, header, variant, tasks, told), daemon=True)
        for core in cores[: min(jobs or len(cores), len(units))]
    ]
    for task in (*units, *[None] * len(processes)):
        tasks.put(task)
    try:
        with interruptible(), board.shown():
            for process in processes:
                process.start()
            follow(len(units), told, processes, board, header, out)
    finally:
        for process in processes:
            if process.is_alive():
                process.terminate()


def follow(units: int, told: Any, processes: list, board: Board, header: Header, out: Path) -> None:
    """Write and show what the processes tell, until all units are done.

    Raises:
        LevelproofError: what a process tells, or that it died.
    """
    while units:
        board.refresh()
        try:
            now = told.get(timeout=POLL)
        except queue.Empty:
            if any(process.exitcode for process in processes):
                raise Failure(f"A process died; run the same command again to go on with {out}.") from None
            continue
        if isinstance(now, LevelproofError):
            raise now
        if isinstance(now, Trained):
            append(out, now, header)
            board.ended(now.unit, now.summary)
            units -= 1
        else:
            board.tally.progress(now.unit, *now.totals)


def append(out: Path, trained: Trained, header: Header) -> None:
    """A unit's lines, after the header in a new file."""
    lines = trained.rows if out.exists() else [header_of(header, trained.versions, trained.device), *trained.rows]
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("a") as file:
        file.write("".join(json.dumps(line) + "\n" for line in lines))


def rows_there(out: Path, header: Header) -> dict[int, dict[str, Any]]:
    """Rows by level id of a file that is to go on; a line that was cut off is removed from it.

    Raises:
        UserError: the file is of another benchmark.
    """
    if not out.exists():
        return {}
    whole, newline, _ = out.read_bytes().rpartition(b"\n")
    if not newline:
        out.unlink()
        return {}
    out.write_bytes(whole + newline)
    before = read(out)
    if before.header != header:
        raise UserError(f"{out} holds {before.header.text} under other settings: choose another --out, or remove it.")
    return before.rows


def work(core: int, header: Header, variant: Variant, tasks: Any, told: Any) -> None:
    """One process: train units until none is left. Compiling is not measured."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the first process ends the others
    prepare_jax(core)
    import jax.numpy as jnp
    import numpy as np

    from experts.train import train_levels
    from levelgen.level import size_of
    from levelgen.sampling.distribution import Distribution
    from levelgen.sampling.sampler import sample_levels

    warm = False
    while (unit := tasks.get()) is not None:
        ids = np.asarray(unit.level_ids, np.int32)
        levels = sample_levels(jnp.asarray(ids), size_of(header.size), Distribution())

        def report(*totals: Any, unit: WorkUnit = unit) -> None:
            told.put(Progress(unit, totals))

        if not warm:
            train_levels(levels, ids, variant.expert.steps_per_update, variant.expert, variant.stop)
            warm = True
        wall, cpu = time.perf_counter(), time.process_time()
        result = train_levels(levels, ids, header.budget, variant.expert, variant.stop, tell=report)
        spent = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        rows = [row_of(int(i), v, spent, len(ids)) for i, v in zip(result.level_ids, result.verdicts, strict=True)]
        solved = sum(verdict.label is Label.SOLVED for verdict in result.verdicts)
        told.put(Trained(unit, rows, Summary(len(ids), solved, *result.spent), versions(), device()))


def row_of(level_id: int, verdict: Verdict, spent: dict[str, float], levels: int) -> dict[str, Any]:
    """A level's line. Its seconds are its part of what its unit took."""
    values = {name: getattr(verdict, name) for name in FIELDS} | {key: s / levels for key, s in spent.items()}
    return {"level_id": level_id} | {name: short(value) for name, value in values.items()}


def short(value: Any) -> Any:
    """As JSON has it: no NaN, few digits."""
    if not isinstance(value, float):
        return value
    return None if math.isnan(value) else round(value, DIGITS)
