"""The job of `levelproof plan`: make some of a job's levels, as `generate` does, and estimate the cost of all."""

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
from levelproof.pipeline.jobs.address import on_this_machine
from levelproof.pipeline.jobs.choice import most_workers, runs_here, workers_here
from levelproof.pipeline.jobs.forecast import LIKELY, Forecast, PerWitness, Sample, forecast
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import labelled
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.event_files import events_of, runs_in
from levelproof.pipeline.store.formats import Encoding
from levelproof.pipeline.store.layout import EXPERTS, split_path
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.progress_bar import say
from levelproof.pipeline.store.scratch import scratch
from levelproof.pipeline.store.shard import stored_bytes, write_shard
from levelproof.pipeline.words import duration, many

SECONDS = 60.0  # approximate time to spend on the sample
MAX_SAMPLE = 4096  # levels
STORED = 256  # maximum number of witnesses written in every density
UNITS = (3600.0, "hours"), (60.0, "minutes"), (1.0, "seconds")  # s; the first that gives more than 1.5 is used


def plan(job: JobConfig, as_json: bool, console: Console) -> None:
    """Print the estimated cost of a job, and the sample behind it.

    Raises:
        UserError: the job is not for random levels.
        Failure: none of the sample's levels could be made.
    """
    if job.level_files:
        raise UserError("plan is for random levels: for level files, `generate` a few and `inspect` their costs.")
    with on_this_machine():
        sample = measure(job, console)
    count = len(job.level_ids)
    workers = min(job.workers or sample.workers, most_workers(job, count))
    cost = forecast(sample, count, workers, job.levels_per_unit, job.unit)
    if as_json:
        basis = {"levels": len(sample.busy), "workers": sample.workers, "wall": sample.wall, "once": sample.once}
        print(json.dumps(cost.as_json() | {"device": sample.device, "sample": basis, "likely": LIKELY}, indent=2))
    else:
        print("\n".join(report_lines(job, sample, cost)))


def report_lines(job: JobConfig, sample: Sample, cost: Forecast) -> list[str]:
    """Return the forecast as lines for the terminal."""
    scale, unit = next((one for one in UNITS if cost.wall.expected > 1.5 * one[0]), UNITS[-1])
    per_solved = cost.seconds_per_solved
    lines = {
        "wall time": f"{cost.wall.text(scale)} {unit} with {many(cost.workers, 'worker')}",
        f"{sample.device}-hours": cost.hours.text(),
        "levels per work unit": f"{cost.unit:,}, {duration(cost.unit_seconds)} on one worker",
        "solved levels": cost.solved.text(form="{:,.0f}".format),
        f"{sample.device}-seconds per solved level": per_solved.text() if per_solved else "unknown",
        **{
            f"GB, density={name}": f"{cost.bytes[name].text(1e9)} in {many(cost.files[name], 'file')}, sealed"
            for name in cost.bytes
        },
    }
    return [
        f"{many(cost.levels, 'level')} of size {job.size}, budget {job.budget}:",
        *(f"  {name + ':':30} {text}" for name, text in lines.items()),
        f"Measured on {len(sample.busy)} of these levels, made on {sample.workers} {sample.device}s here in "
        f"{duration(sample.wall)}; {LIKELY:.0%} of outcomes fall within the intervals. This assumes workers as fast as "
        f"those here, {duration(sample.once)} for starting and for the last levels, and programs already compiled "
        f"(else {duration(sample.compiling)} more per worker).",
    ]


def measure(job: JobConfig, console: Console, seconds: float = SECONDS) -> Sample:
    """Make some of a job's first levels: a few to learn how many fit into `seconds`, then that many."""
    levels = len(job.level_ids)
    unit = min(job.levels_per_unit, replace(job, unit=None).levels_per_unit)  # a larger one would take hours
    inline = runs_here(job, levels)
    here = workers_here(job, levels) if inline else min(job.workers or len(own_cores()), len(own_cores()))
    job = replace(job, executor="inline" if inline else "ray", unit=job.unit and unit)
    with scratch() as folder, _announced(console, seconds):
        split, begun = split_path(str(folder), job.budget, job.size), time.monotonic()
        some = min(levels, MAX_SAMPLE, here * unit)
        first = _make(job, folder, some, here)
        here = _workers_of(split)  # fewer if memory or GPUs do not suffice for one per core
        _, busy, _ = costs_of(split)
        more = int(seconds * here / max(busy.mean(), 1e-6)) // unit * unit
        count, wall = min(levels, MAX_SAMPLE, max(some, more)), first
        if count > some:
            wall = _make(job, folder, count, here)
        table, busy, compiling = costs_of(split)
        new, compiled = (busy[some:], 0.0) if count > some else (busy, compiling.sum())
        prepare_jax()
        return Sample(
            device="GPU" if not table.column("device")[0].as_py().startswith("cpu") else "core",
            workers=here,
            wall=time.monotonic() - begun,
            once=max(0.0, wall - (new.sum() + compiled) / here),
            compiling=compiling[:some].sum() / here,
            busy=busy,
            solved=labelled(table, [Label.SOLVED]),
            witnessed=labelled(table, WITNESSED),
            row_bytes=_row_bytes(table),
            stored=_stored(job, split, table, folder),
            expert_bytes=sum(file.stat().st_size for file in (split / EXPERTS).glob("*.npz")) / table.num_rows,
        )


def _make(job: JobConfig, folder: Path, count: int, workers: int) -> float:
    """Generate what is missing of a job's first `count` levels; return the seconds that it took."""
    here, quiet = replace(job, out=str(folder), workers=workers, log="none"), Console(quiet=True)
    begun = time.monotonic()
    with redirect_stdout(io.StringIO()):
        generate(here, ["levelproof", "plan"], quiet, level_ids=job.level_ids[:count])
    return time.monotonic() - begun


def _workers_of(split: Path) -> int:
    """Return the number of workers of the latest run."""
    (*_, last) = events_of(runs_in(split)[-1])
    return max(1, sum(host["count"] for host in last["workers"].values()))


def costs_of(split: Path) -> tuple[pa.Table, np.ndarray, np.ndarray]:
    """Return the sample's rows, and for each the seconds of a worker without and for compiling.

    Raises:
        Failure: there are no rows.
    """
    table = read_manifest(split).table
    if not table.num_rows:
        raise Failure(
            "No level could be made on this machine: run `levelproof generate` with these settings to see why."
        )
    column = table.column("seconds")
    cost = Seconds(*(pc.struct_field(column, stage).to_numpy().astype(float) for stage in Seconds._fields))  # pyright: ignore[reportAttributeAccessIssue]
    return table, np.asarray(cost.working), np.asarray(cost.compiling)


def _row_bytes(table: pa.Table) -> float:
    """Return the mean compressed size of a manifest row, in bytes."""
    whole = pa.BufferOutputStream()
    pq.write_table(table, whole, compression="zstd")
    return whole.getvalue().size / table.num_rows


def _stored(job: JobConfig, split: Path, table: pa.Table, folder: Path) -> dict[str, PerWitness]:
    """Return the stored size of a witness by density; empty if the sample has none."""
    rows = table.filter(table.column("shard").is_valid())[:STORED]
    if not rows.num_rows:
        return {}
    arrays, ids = read_rows(split, rows), rows.column("level_id").to_pylist()
    sizes = {}
    for density in ("full",) if job.task.frame_skip > MAX_FRAME_SKIP else ("full", "resume", "witness"):
        path = folder / f"{density}.zarr"
        write_shard(path, ids, arrays, Encoding(density, job.key_every, job.task))
        sizes[density] = PerWitness(stored_bytes(path) / len(ids), sum(entry.is_dir() for entry in path.iterdir()))
    return sizes


@contextmanager
def _announced(console: Console, seconds: float) -> Iterator[None]:
    """Tell the user that the `with` block takes a while."""
    text = f"making some of the levels here: about {duration(seconds)}, plus compiling ..."
    if not console.is_interactive:
        say(console, text.capitalize())
        yield
        return
    with console.status(text):
        yield
