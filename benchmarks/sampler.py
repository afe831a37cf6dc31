"""Levels/s of our sampler and of the reference's, and the seconds of their first calls, compiling included.

One process each, in turn, on all cores with default threads and without a compilation cache.
"""

import argparse
import json
from collections.abc import Mapping

from benchmarks import oracle
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES

LEVELS = 4096


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, default=LEVELS, help=f"levels of a timed call (default: {LEVELS:,})")


def run(args: argparse.Namespace) -> Report:
    python = oracle.oracle_python()
    results = []
    for size in args.size:
        arguments = ["--size", size, "--levels", args.levels]
        ours = json.loads(oracle.run_ours("sampler", arguments))
        theirs = json.loads(oracle.run_script(python, "sampler", arguments, "sample levels with the reference"))
        results.append(result(size, ours, theirs))
    first = "first call, s", "of that, LLVM and XLA", "reference's first call, s"
    head = ("size", *first, "levels/s", "reference's levels/s", "ratio")
    return Report(
        title="Samplers",
        results=results,
        tables=[Table(head, [row(result) for result in results])],
        notes=[f"{args.levels:,} levels of ours in blocks of 256; the reference in batches of 512, two for m and l."],
        reference=oracle.versions(python),
    )


def result(size: str, ours: Mapping[str, float], theirs: Mapping[str, float]) -> dict:
    return {
        "size": size,
        "unit": "levels/s",
        "ours": ours["rate"],
        "reference": theirs["rate"],
        "ratio": ours["rate"] / theirs["rate"],
        "first_call_seconds": {"ours": ours["first"], "compiling": ours["compiling"], "reference": theirs["first"]},
    }


def row(result: Mapping) -> list[str]:
    first = result["first_call_seconds"]
    rates = f"{result['ours']:,.0f}", f"{result['reference']:,.0f}", f"{result['ratio']:.1f}"
    seconds = f"{first['ours']:.2f}", f"{first['compiling']:.2f}", f"{first['reference']:.0f}"
    return [result["size"], *seconds, *rates]
