"""The job of `levelproof plan`: makes some of a job's levels, as `generate` does, and says what all would take."""

import io
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rich.console import Console

from levelproof.configs.schema import MAX_FRAME_SKIP, JobConfig
from levelproof.experts.labels import WITNESSED, Label
from levelproof.experts.steps import Seconds
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.forecast import LIKELY, Forecast, PerWitness, Sample, forecast
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.events import events_of, runs_in
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.schema import Encoding
from levelproof.pipeline.store.scratch import scratch
from levelproof.pipeline.store.shard import stored_bytes, write_shard
from levelproof.pipeline.words import duration, many

SECONDS = 60.0  # of making levels, about
MOST = 4096  # levels
STORED = 256  # witnesses that are written in every density
UNITS = (3600.0, "hours"), (60.0, "minutes"), (1.0, "seconds")  # s, the first that is short enough


def plan(job: JobConfig, as_json: bool, console: Console) -> None:
    """Print what a job would take, and what that rests on.

    Raises:
        UserError: levels that no id makes.
        Failure: none of the sample's levels could be made.
    """
    if job.level_files:
        raise UserError("plan is for random levels: of level files, `generate` labels a few, and `inspect` tells more.")
    sample = measured(job, console)
    found = forecast(sample, len(job.level_ids), job.workers or sample.workers, job.levels_per_unit, job.unit)
    if as_json:
        of = {"levels": len(sample.busy), "workers": sample.workers, "wall": sample.wall, "once": sample.once}
        print(json.dumps(found.as_json() | {"device": sample.device, "sample": of, "likely": LIKELY}, indent=2))
    else:
        print("\n".join(told(job, sample, found)))


def told(job: JobConfig, sample: Sample, of: Forecast) -> list[str]:
    """In lines for people."""
    scale, unit = next((one for one in UNITS if of.wall.expected > 1.5 * one[0]), UNITS[-1])
    lines = {
        "wall time": f"{of.wall.told(scale)} {unit} with {many(of.workers, 'worker')}",
        f"{sample.device}-hours": of.hours.told(),
        "levels a work unit": f"{of.unit:,}, {duration(of.unit_seconds)} of a worker",
        "solved levels": of.solved.told(tell="{:,.0f}".format),
        f"{sample.device}-seconds a solved level": of.seconds_per_solved.told() if of.seconds_per_solved else "unknown",
        **{
            f"GB, density={name}": f"{of.bytes[name].told(1e9)} in {many(of.files[name], 'file')}, sealed"
            for name in of.bytes
        },
    }
    return [
        f"{many(of.levels, 'level')} of size {job.size}, {job.budget} env steps each:",
        *(f"  {name + ':':30} {text}" for name, text in lines.items()),
        f"From {len(sample.busy)} of them, made on {sample.workers} {sample.device}s here in {duration(sample.wall)}; "
        f"in {LIKELY:.0%} of cases it is within the interval. All workers are taken to be like those here, "
        f"{duration(sample.once)} to go for starting and for the last levels, and programs to be compiled "
        f"({duration(sample.compiling)} a worker otherwise).",
    ]


def measured(job: JobConfig, console: Console, seconds: float = SECONDS) -> Sample:
    """What some of a job's first levels take here: a few that say how many are made in so many seconds, then those."""
    levels, unit = len(job.level_ids), job.levels_per_unit
    here = 1 if job.executor == "inline" else min(job.workers or len(own_cores()), len(own_cores()))
    with scratch() as folder, _told(console, seconds):
        split, begun = split_path(str(folder), job.budget, job.size), time.monotonic()
        some = min(levels, here * unit)
        first = _made(job, folder, some, here)
        here = _workers_of(split)  # fewer where memory or GPUs do not suffice for one a core
        _, busy, _ = costs_of(split)
        more = int(seconds * here / max(busy.mean(), 1e-6)) // unit * unit
        count, wall = min(levels, MOST, max(some, more)), first
        if count > some:
            wall = _made(job, folder, count, here)
        table, busy, compiling = costs_of(split)
        new = busy[some:] if count > some else busy
        labels = np.array(table.column("label").to_pylist())
        prepare_jax()
        return Sample(
            device="GPU" if not table.column("device")[0].as_py().startswith("cpu") else "core",
            workers=here,
            wall=time.monotonic() - begun,
            once=max(0.0, wall - new.sum() / here),
            compiling=compiling[:some].sum() / here,
            busy=busy,
            solved=labels == Label.SOLVED,
            witnessed=np.isin(labels, [label.value for label in WITNESSED]),
            row_bytes=_row_bytes(table),
            stored=_stored(job, split, table, folder),
        )


def _made(job: JobConfig, folder: Path, count: int, workers: int) -> float:
    """Seconds in which `generate` makes those of a job's first levels that are not there."""
    here, quiet = replace(job, out=str(folder), workers=workers, log="none"), Console(quiet=True)
    begun = time.monotonic()
    with redirect_stdout(io.StringIO()):
        generate(here, ["levelproof", "plan"], quiet, level_ids=job.level_ids[:count])
    return time.monotonic() - begun


def _workers_of(split: Path) -> int:
    """How many the latest run had."""
    (*_, last) = events_of(runs_in(split)[-1])
    return max(1, sum(of["count"] for of in last["workers"].values()))


def costs_of(split: Path) -> tuple[pa.Table, np.ndarray, np.ndarray]:
    """The sample's rows, what each level took of a worker, and what was compiled meanwhile."""
    table = read_manifest(split).table
    if not table.num_rows:
        raise Failure("None of the levels could be made here: `levelproof generate` with the same words says why.")
    column = table.column("seconds")
    of = Seconds(*(pc.struct_field(column, stage).to_numpy().astype(float) for stage in Seconds._fields))  # pyright: ignore[reportAttributeAccessIssue]
    return table, np.asarray(of.working), np.asarray(of.compiling)


def _row_bytes(table: pa.Table) -> float:
    whole = pa.BufferOutputStream()
    pq.write_table(table, whole, compression="zstd")
    return whole.getvalue().size / table.num_rows


def _stored(job: JobConfig, split: Path, table: pa.Table, folder: Path) -> dict[str, PerWitness]:
    """What witnesses take in each density; nothing where there are none."""
    rows = table.filter(table.column("shard").is_valid())[:STORED]
    if not rows.num_rows:
        return {}
    arrays, ids = read_rows(split, rows), rows.column("level_id").to_pylist()
    found = {}
    for density in ("full",) if job.task.frame_skip > MAX_FRAME_SKIP else ("full", "resume", "witness"):
        path = folder / f"{density}.zarr"
        write_shard(path, ids, arrays, Encoding(density, job.key_every, job.task))
        found[density] = PerWitness(stored_bytes(path) / len(ids), sum(entry.is_dir() for entry in path.iterdir()))
    return found


@contextmanager
def _told(console: Console, seconds: float) -> Iterator[None]:
    """Say that it takes a while."""
    text = f"making some of the levels here, for about {duration(seconds)} and what it takes to compile ..."
    if not console.is_terminal:
        say(console, text.capitalize())
        yield
        return
    with console.status(text):
        yield
