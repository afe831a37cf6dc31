"""Trajectories/s of both readers on the same trajectories: random batches, every field, two cores each.

Our reader gets a sealed split, once with every field stored (`full`), once with little more than actions (`witness`,
which it simulates again); the reference gets that split from `levelproof export --format kinetix`. Both read from the
page cache.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store.shard import stored_bytes

BATCH = 64
BUDGET = "64k"
LEVELS = {"s": 512, "m": 192, "l": 128}  # labelled; about two thirds get a witness
DENSITIES = ("full", "witness")
TABLES = {
    "rate": "Trajectories/s",
    "copied": "Trajectories/s, with every array copied as well",
    "core_rate": "Trajectories/s of a core",
}
TARGETS = {"s": 6, "m": 5, "l": 3}  # multiples of the reference's rate


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--seconds", type=float, default=4.0, help="seconds of each measurement (default: 4)")


def run(args: argparse.Namespace) -> Report:
    python = oracle.oracle_python()
    results = [measured(python, size, args.seconds) for size in args.size]
    copied = {each["size"]: each["ours"]["full"]["copied"] / each["reference"]["copied"] for each in results}
    missed = [size for size, times in copied.items() if times < TARGETS[size]]
    return Report(
        title="Reading trajectories",
        results=results,
        tables=[table(results, what, title) for what, title in TABLES.items()],
        notes=[
            f"Random batches of {BATCH} whole trajectories with every field, after as many seconds to warm up; the "
            "reference draws runs of neighbours, our reader draws trajectories one by one. Both return arrays (batch, "
            "time, ...) that are views of what they decoded; the second table adds the CPU time of copying each array.",
            f"Targets for *full* in the second table: {', '.join(f'{n}x for {size}' for size, n in TARGETS.items())}. "
            f"{'Missed by ' + ', '.join(missed) if missed else 'All are met'}.",
        ],
        reference=oracle.versions(python),
    )


def measured(python: Path, size: str, seconds: float) -> dict[str, Any]:
    """Measure both readers on one split."""
    folders = folders_of(size)
    arguments = ["--batch", BATCH, "--seconds", seconds]
    ours = {density: json.loads(oracle.run_ours("reader", [folders[density], *arguments])) for density in DENSITIES}
    theirs = json.loads(
        oracle.run_script(python, "batches", [folders["kinetix"], *arguments], "read trajectories with the reference")
    )
    stored = {density: sum(map(stored_bytes, (folders[density] / "shards").iterdir())) for density in DENSITIES}
    return {"size": size, "unit": "trajectories/s", "ours": ours, "reference": theirs, "bytes": stored}


def table(results: list[dict[str, Any]], what: str, title: str) -> Table:
    rows = []
    for result in results:
        theirs = result["reference"][what]
        cells = [f"{result['ours'][density][what]:,.0f}" for density in DENSITIES]
        ratios = [f"{result['ours'][density][what] / theirs:.1f}x" for density in DENSITIES]
        rows.append([result["size"], *cells, f"{theirs:,.0f}", *ratios])
    head = (
        "size",
        *(f"ours, {density}" for density in DENSITIES),
        "reference",
        *(f"{density}, times" for density in DENSITIES),
    )
    return Table(head, rows, title)


def folders_of(size: str) -> dict[str, Path]:
    """Return folders with the same trajectories, made on first use: a split of each density, and the export."""
    home = cache_folder() / "bench" / "reader"
    source = home / "generated" / BUDGET / size
    with oracle.alone(cache_folder() / "bench.lock"):
        if not source.is_dir():
            oracle.log(f"Labelling {LEVELS[size]} levels of size {size} to read (once, one to five minutes) ...")
            unfinished = home / "unfinished"  # a stopped job resumes
            oracle.run_levelproof(
                "generate", f"size={size}", f"levels={LEVELS[size]}", f"budget={BUDGET}", f"out={unfinished}"
            )
            source.parent.mkdir(parents=True, exist_ok=True)
            (unfinished / BUDGET / size).replace(source)
        folders = {name: home / name / size for name in (*DENSITIES, "kinetix")}
        for density in DENSITIES:
            if not folders[density].is_dir():
                unfinished = folders[density].with_name(f"unfinished-{size}")
                shutil.rmtree(unfinished, ignore_errors=True)
                shutil.copytree(source, unfinished)
                oracle.run_levelproof("seal", unfinished, "--density", density)
                unfinished.replace(folders[density])
        if not folders["kinetix"].is_dir():
            oracle.run_levelproof(
                "export",
                folders["full"],
                "--format",
                "kinetix",
                "--where",
                "shard IS NOT NULL",
                "-o",
                folders["kinetix"],
            )
    return folders
