"""The first run: `levelproof generate` with nothing compiled, the same job once more, and a larger one after that.

Each run starts from an empty cache folder: the first command compiles, the second makes the same levels in another
folder, the third a larger job with the same programs. Machines differ threefold, so every run also times one fixed
program in a process of its own.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.night import below, process_file
from benchmarks.report import Report, Table
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.look.cost import READ, cost_of
from levelproof.pipeline.runtime import CACHE_VARIABLE
from levelproof.pipeline.store.manifest import read_manifest

LARGER = "levels=512 budget=256k"
COLD, WARM, FULL = "cold", "warm", "larger"
TARGETS = {COLD: 30.0, WARM: 10.0}  # s of wall time, on two cores
TARGET_SHARE = 0.1  # of the larger job's core-seconds, compiling, tracing and loading
POLL = 0.1  # s between polls of the processes
TICKS = os.sysconf("SC_CLK_TCK")  # per second
# Twenty products of matrices and reductions, as in a network: XLA's optimiser and LLVM both take part
CALIBRATION = """
import time, jax, jax.numpy as jnp
def program(x):
    for i in range(20):
        x = jnp.tanh(x @ (x.T * i)) + jnp.sort(x, axis=0).sum(1)
    return x
lowered = jax.jit(program).lower(jax.ShapeDtypeStruct((16, 16), "float32"))
start = time.perf_counter()
lowered.compile()
print(time.perf_counter() - start)
"""


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", help="settings of the first two jobs (default: none, so 64 levels)")
    parser.add_argument("--larger", default=LARGER, help=f"settings of the third job (default: {LARGER}); '': none")
    parser.add_argument("--runs", type=int, default=3, help="runs, of which medians are reported (default: 3)")


def run(args: argparse.Namespace) -> Report:
    jobs = {COLD: args.settings, WARM: args.settings} | ({FULL: args.larger.split()} if args.larger else {})
    return reported(jobs, [result for number in range(args.runs) for result in _from_nothing(jobs, number)])


def reported(jobs: Mapping[str, Sequence[str]], results: Sequence[Mapping[str, Any]]) -> Report:
    """Report the medians of runs; `jobs` are settings by name."""
    runs = len({result["run"] for result in results})
    times = "One run" if runs == 1 else f"Medians of {runs} runs"
    medians = {name: _median([result for result in results if result["job"] == name]) for name in jobs}
    calibration = float(np.median([result["calibration"] for result in results]))
    missed = [f"{name} takes {medians[name]['wall']:.0f} s, not {limit:.0f}" for name, limit in TARGETS.items()
              if medians[name]["wall"] > limit]  # fmt: skip
    if FULL in medians and medians[FULL]["compiling"] > TARGET_SHARE:
        missed.append(f"the larger job spends {medians[FULL]['compiling']:.0%} on compiling, not {TARGET_SHARE:.0%}")
    head = ("job", "settings", "wall time, s", "core-seconds of all processes", "levels", "of that, compiling")
    return Report(
        title="From nothing to the first levels",
        results=results,
        tables=[Table(head, [_row(name, jobs[name], medians[name]) for name in jobs])],
        notes=[
            f"{times} of `levelproof generate`. *cold*: with an empty cache folder. *warm*: the same "
            "command into another folder, with the programs that *cold* has left. *larger*: another job with the same "
            "programs. *levels*: core-seconds that workers charge to levels; compiling includes tracing and loading.",
            f"To compile a fixed program took {calibration:.2f} s in the same runs (median).",
            f"Targets on two cores: {', '.join(f'{name} {limit:.0f} s' for name, limit in TARGETS.items())}, compiling "
            f"{TARGET_SHARE:.0%} of the larger job. {'Missed: ' + '; '.join(missed) if missed else 'All are met'}.",
        ],
    )  # fmt: skip


def _from_nothing(jobs: dict[str, Sequence[str]], number: int) -> list[dict[str, Any]]:
    """Run the jobs, one after another, from an empty cache folder."""
    with tempfile.TemporaryDirectory() as name:
        environment = os.environ | {CACHE_VARIABLE: str(Path(name, "cache"))}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python would compile all sources in every run
        calibration = float(subprocess.check_output([sys.executable, "-c", CALIBRATION], text=True))
        return [
            {"run": number, "job": job, "calibration": calibration, **generated(settings, Path(name, job), environment)}
            for job, settings in jobs.items()
        ]


def generated(settings: Sequence[str], out: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Generate a split; return its wall time and the core-seconds of its processes and of its levels.

    Raises:
        Failure: the command fails.
    """
    command = [sys.executable, "-m", "levelproof", "generate", *settings, f"out={out}"]
    start = time.perf_counter()
    process = subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    seconds: dict[int, float] = {}
    watch = threading.Thread(target=_watch, args=(process, seconds))
    watch.start()
    output, _ = process.communicate()
    wall = time.perf_counter() - start
    watch.join()
    if process.returncode:
        raise Failure(f"`{' '.join(command)}` fails with {process.returncode}:\n{output[-2000:]}")
    (split,) = (path.parent for path in out.glob("*/*/manifest"))
    cost = cost_of(read_manifest(split, READ).table)
    assert cost
    levels = sum(cost["seconds"].values())
    of_levels = {"levels": levels, "compiling": cost["seconds"]["compiling"] / levels}
    return {"wall": wall, "core_seconds": sum(seconds.values()), **of_levels}


def _watch(process: subprocess.Popen[str], seconds: dict[int, float]) -> None:
    """Record the core-seconds of a process and its descendants until it ends; time after the last poll is lost."""
    while process.poll() is None:
        seconds.update(core_seconds(process.pid))
        time.sleep(POLL)


def core_seconds(pid: int) -> dict[int, float]:
    """Return user and system seconds of a process and of its live descendants."""
    fields = {each: process_file(each, "stat").rpartition(")")[2].split() for each in (pid, *below(pid))}
    return {each: (int(stat[11]) + int(stat[12])) / TICKS for each, stat in fields.items() if stat}


def _median(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    names = ("wall", "core_seconds", "levels", "compiling")
    return {name: float(np.median([result[name] for result in results])) for name in names}


def _row(job: str, settings: Sequence[str], medians: dict[str, float]) -> list[str]:
    numbers = [f"{medians[name]:.1f}" for name in ("wall", "core_seconds", "levels")]
    return [job, f"`{' '.join(settings)}`" if settings else "defaults", *numbers, f"{medians['compiling']:.0%}"]
