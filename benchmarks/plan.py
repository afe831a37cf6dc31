"""The forecast of `levelproof plan` against the job itself, sealed, on the same cores."""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.look.cost import READ, cost_of
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.shard import stored_bytes
from levelproof.pipeline.words import number

TARGET = 0.15  # relative error of the wall time
SIZE, LEVELS, BUDGET = "s", "4k", "64k"


def register(parser: argparse.ArgumentParser) -> None:
    arguments = [f"size={SIZE}", f"levels={LEVELS}", f"budget={BUDGET}"]
    parser.add_argument(
        "settings", nargs="*", default=arguments, help=f"settings of the job (default: {' '.join(arguments)})"
    )


def run(args: argparse.Namespace) -> Report:
    with tempfile.TemporaryDirectory() as out:
        planned = json.loads(_levelproof("plan", *args.settings, "--json"))
        start = time.monotonic()
        _levelproof("generate", *args.settings, f"out={out}")
        wall = time.monotonic() - start
        (split,) = (path.parent for path in Path(out).glob("*/*/manifest"))
        _levelproof("seal", str(split))
        measurements = {"wall": wall, **measured(split, planned["workers"], wall)}
    results = [compared(name, planned, measurements[name]) for name in measurements]
    head = ("", "forecast", "interval", "measured", "forecast / measured")
    off = abs(results[0]["ratio"] - 1)
    return Report(
        title="A forecast against its run",
        results=results,
        tables=[Table(head, [row(result) for result in results])],
        notes=[
            f"`levelproof plan {' '.join(args.settings)}` made {planned['sample']['levels']} of the levels in "
            f"{planned['sample']['wall']:.0f} s, compiling included, on {planned['sample']['workers']} workers; then "
            f"`levelproof generate` made all {planned['levels']:,} with {planned['workers']} workers, with the same "
            "compiled programs. *interval*: holds nine cases in ten. *bytes* and *files* are those of the sealed split."
        ],
        fault=f"The wall time is {off:.0%} off; the target is {TARGET:.0%}." if off > TARGET else "",
    )


def measured(split: Path, workers: int, wall: float) -> dict[str, Any]:
    """Measure what `plan` forecasts on a split that was generated in `wall` s and sealed."""
    table = read_manifest(split, READ).table
    labels, cost = table.column("label").to_pylist(), cost_of(table)
    assert cost is not None
    solved = labels.count(Label.SOLVED)
    folders = [split / name for name in ("manifest", "shards")]
    return {
        "hours": wall * workers / 3600,
        "solved": solved,
        "seconds_per_solved": wall * workers / solved if solved else None,
        "bytes": sum(map(stored_bytes, folders)),
        "files": 1 + sum(not path.is_dir() for folder in folders for path in folder.rglob("[!.]*")),
    }


def compared(name: str, planned: Mapping[str, Any], value: float) -> dict[str, Any]:
    guess = planned[name]["full"] if name in ("bytes", "files") else planned[name]
    guess = guess if isinstance(guess, dict) else {"expected": guess, "low": guess, "high": guess}
    return {"what": name, **guess, "measured": value, "ratio": guess["expected"] / value}


def row(result: Mapping[str, Any]) -> Sequence[str]:
    names = {"wall": "wall time, s", "hours": "core- or GPU-hours", "seconds_per_solved": "seconds a solved level"}
    interval = f"{number(result['low'])} to {number(result['high'])}" if result["low"] < result["high"] else "-"
    name = names.get(str(result["what"]), str(result["what"]))
    return [name, number(result["expected"]), interval, number(result["measured"]), f"{result['ratio']:.2f}"]


def _levelproof(*arguments: str) -> str:
    oracle.log(f"levelproof {' '.join(arguments)}")
    command, environment = [sys.executable, "-m", "levelproof", *arguments], dict(oracle.our_environment())
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        raise Failure(
            f"`levelproof {' '.join(arguments)}` ended with exit code {done.returncode}: see its message above."
        )
    return done.stdout
