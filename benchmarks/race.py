"""A race of both sides on the same levels, in turns: the division among cores, and the summary of rates."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import oracle
from benchmarks.contest import Entry, Score, compete
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import own_cores

OURS, PINNED, FREE = "ours", "reference, process per core", "reference, one process"


@dataclass(frozen=True)
class Share:
    """The lanes or levels of one process."""

    core: int | None  # None: all cores
    first: int
    count: int


@dataclass(frozen=True)
class Result:
    """Result of a race; rates are medians of env steps/s of the whole machine, the reference's by its faster way."""

    size: str
    unit: str
    ours: float
    reference: float
    ratio: float  # ours / reference
    reference_way: str  # the faster of its ways to run
    ways: dict[str, float]  # median of each contestant
    spread: dict[str, list[float]]  # smallest and largest run of each
    runs: dict[str, list[float]]
    compile_seconds: dict[str, float]  # of each contestant, slowest process, nothing cached
    compile_ratio: float  # ours / the faster compiling way of the reference
    goal_share: dict[str, float | None]  # of finished episodes: checks that both sides play the same game
    finite: bool  # no NaN or infinity anywhere
    settings: dict[str, Any]


def register(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of every race."""
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=["s"], help="sizes of levels (default: s)")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each side; medians count (default: 5)")
    parser.add_argument("--level-file", type=Path, help="levels as the reference's arrays (default: it samples some)")


def check(args: argparse.Namespace, counts: Sequence[str]) -> None:
    """Check that counts are positive and that the level file exists.

    Raises:
        UserError: a check fails.
    """
    for name in counts:
        if (value := getattr(args, name)) is not None and value < 1:
            raise UserError(f"--{name.replace('_', '-')} is {value}, but must be at least 1.")
    if args.level_file is not None and not args.level_file.is_file():
        raise UserError(f"The file {args.level_file} does not exist: give levels as .npz, or leave --level-file out.")


def shares(count: int, cores: Sequence[int]) -> list[Share]:
    """Split `count` items evenly over cores; omit cores that get none."""
    cuts = np.linspace(0, count, min(len(cores), count) + 1).round().astype(int).tolist()
    return [Share(core, a, b - a) for core, a, b in zip(cores, cuts, cuts[1:], strict=False)]


def contestants(
    script: str, count: int, steps: int, ours: Callable[[Share], list[object]], theirs: Callable[[Share], list[object]]
) -> list[Entry]:
    """Make the entries: ours, the reference with a process per core, and the reference with one process on all cores.

    Args:
        script: file name in benchmarks/ours and in benchmarks/reference.
        count: lanes or levels to divide among processes.
        steps: env steps of all processes in a run.
        ours: arguments of our process for its share.
        theirs: arguments of the reference's process for its share.
    """
    cores, python = own_cores(), oracle.oracle_python()
    shared, whole = shares(count, cores), [Share(None, 0, count)]

    def entry(
        name: str, start: Sequence[object], arguments: Callable[[Share], list[object]], split: list[Share]
    ) -> Entry:
        commands = [[str(x) for x in (*start, *arguments(share), *_on(share.core))] for share in split]
        return Entry(name, commands, oracle.our_environment() if name == OURS else oracle.environment(), steps)

    start = [python, oracle.SCRIPTS / f"{script}.py"]
    entries = [
        entry(OURS, [sys.executable, "-m", f"benchmarks.ours.{script}"], ours, shared),
        entry(PINNED, start, theirs, shared),
    ]
    return [*entries, entry(FREE, start, theirs, whole)] if len(cores) > 1 else entries


def run(
    title: str, args: argparse.Namespace, entries: Callable[[str], list[Entry]], settings: Mapping[str, Any]
) -> Report:
    """Run a race for each size."""
    results = [summary(size, settings, compete(entries(size), args.repeats)) for size in args.size]
    diverged = ", ".join(result.size for result in results if not result.finite)
    return Report(
        title=title,
        results=[asdict(result) for result in results],
        tables=[rates(results), details(results)],
        notes=[", ".join(f"{name} {value}" for name, value in settings.items())],
        reference=oracle.versions(oracle.oracle_python()),
        fault=f"A state or a weight of size {diverged} is not finite: do not trust these numbers." if diverged else "",
    )


def summary(size: str, settings: Mapping[str, Any], scores: Sequence[Score]) -> Result:
    """Summarise a race; the first of `scores` is ours, the others are ways to run the reference."""
    ours, *others = scores
    best = max(others, key=lambda score: score.rate)
    named = {score.entry.name: score for score in scores}
    theirs = min(score.compile_seconds for score in others)
    return Result(
        size=size,
        unit="env steps/s",
        ours=ours.rate,
        reference=best.rate,
        ratio=ours.rate / best.rate,
        reference_way=best.entry.name,
        ways={name: score.rate for name, score in named.items()},
        spread={name: [min(score.rates), max(score.rates)] for name, score in named.items()},
        runs={name: score.rates for name, score in named.items()},
        compile_seconds={name: score.compile_seconds for name, score in named.items()},
        compile_ratio=ours.compile_seconds / theirs,
        goal_share={name: score.goals / score.episodes if score.episodes else None for name, score in named.items()},
        finite=all(score.finite for score in scores),
        settings=dict(settings),
    )


def rates(results: Sequence[Result]) -> Table:
    """Make a row per size: our rate, and each way of the reference with its ratio."""
    ways = list(results[0].ways)[1:]
    head = ["size", "ours, env steps/s", *(title for way in ways for title in (way, "ratio"))]
    rows = []
    for result in results:
        theirs = [
            cell for way in ways for cell in (f"{result.ways[way]:,.0f}", f"{result.ours / result.ways[way]:.3g}")
        ]
        rows.append([result.size, f"{result.ours:,.0f}", *theirs])
    return Table(head, rows)


def details(results: Sequence[Result]) -> Table:
    """Make a row per size and contestant."""
    rows = []
    for result in results:
        for way, (low, high) in result.spread.items():
            goals = result.goal_share[way]
            seconds, share = f"{result.compile_seconds[way]:.1f}", "-" if goals is None else f"{goals:.1%}"
            rows.append([result.size, way, f"{low:,.0f} to {high:,.0f}", seconds, share])
    return Table(("size", "side", "runs, env steps/s", "compile, s", "episodes that reach the goal"), rows)


def _on(core: int | None) -> list[object]:
    return [] if core is None else ["--core", core]
