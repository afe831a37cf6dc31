"""The words of `python -m benchmarks`, and what each bench starts."""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

import benchmarks
from benchmarks import oracle
from benchmarks.race.contest import Entry, compete
from benchmarks.race.report import Result, summary, write_json, write_table
from benchmarks.reference.actions import STICKINESS, sticky_actions
from levelgen.level import size_of
from physics.types import FIXED_POLYGONS
from pipeline.errors import Exit, UserError
from pipeline.runtime import own_cores, prepare_jax

CUSTOM = "8-8-8-4"  # a size without a name, for parity
OURS, PINNED, FREE = "ours", "reference, process per core", "reference, one process"


def main(argv: Sequence[str]) -> int:
    """Run one bench; its exit code."""
    given = _parser().parse_args(argv)
    for name, value in vars(given).items():
        if isinstance(value, int) and value < 1 and name != "json":
            raise UserError(f"--{name.replace('_', '-')} is {value}: it has to be at least 1.")
    if given.level_file is not None and not given.level_file.is_file():
        raise UserError(f"There is no file {given.level_file}: give levels as .npz, or leave --level-file out.")
    given.run(given)
    return Exit.DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure this program beside the reference (Kinetix 3.0.2) in the same run: same machine, levels "
        "and actions, in turns. The reference runs in an environment of its own, made on first use in the cache folder "
        f"(LEVELPROOF_CACHE_DIR); {oracle.PYTHON_VARIABLE} names a Python that has it already.",
        epilog="example: python -m benchmarks physics --size s --json",
    )
    benches = parser.add_subparsers(metavar="BENCH", required=True)

    def bench(name: str, run: Callable[[argparse.Namespace], None], does: str) -> argparse.ArgumentParser:
        sub = benches.add_parser(
            name,
            help=does,
            description=f"{does[0].upper()}{does[1:]}.",
            epilog=f"example: python -m benchmarks {name} --size s",
        )
        sub.add_argument("--level-file", type=Path, help="levels as the reference's arrays (default: it samples some)")
        sub.add_argument("--json", action="store_true", help="print JSON")
        sub.set_defaults(run=run)
        return sub

    def race(name: str, run: Callable[[argparse.Namespace], Result], does: str) -> argparse.ArgumentParser:
        sub = bench(name, lambda given: _race(run, given), does)
        sub.add_argument("--size", choices=["s", "m", "l"], default="s", help="of the levels (default: s)")
        sub.add_argument("--repeats", type=int, default=5, help="timed runs of each side; medians count (default: 5)")
        return sub

    sub = race("physics", physics, "env steps a second under random actions, without observations")
    sub.add_argument("--lanes", type=int, default=1024, help="worlds stepped side by side (default: 1024)")
    sub.add_argument("--steps", type=int, default=64, help="env steps of a run in each lane (default: 64)")
    sub.add_argument("--block", type=int, default=128, help="lanes our engine steps together (default: 128)")
    sub.add_argument("--reference-block", type=int, help="the same for the reference (default: all of a process)")

    sub = race("experts", experts, "env steps a second of training one expert per level")
    sub.add_argument("--levels", type=int, default=32, help="levels, one expert each (default: 32)")
    sub.add_argument("--environments", type=int, default=32, help="lanes of an expert (default: 32)")
    sub.add_argument("--horizon", type=int, default=64, help="env steps in each lane between updates (default: 64)")
    sub.add_argument("--updates", type=int, default=4, help="updates of a run (default: 4)")

    sub = bench(
        "parity", parity, "how far the physics is from the reference's: one step from many states, and episodes"
    )
    sub.add_argument(
        "--size",
        nargs="+",
        type=_size,
        default=["s", "m", "l", CUSTOM],
        help=f"of the worlds: s, m, l or POLYGONS-CIRCLES-JOINTS-THRUSTERS (default: s m l {CUSTOM})",
    )
    sub.add_argument("--states", type=int, default=10_000, help="states a size to take one step from (default: 10,000)")
    sub.add_argument("--episodes", type=int, default=1_000, help="levels with actions to play, a size (default: 1,000)")
    sub.add_argument("--keep", type=Path, help="folder for the reference's answers: next time only our side runs")
    return parser


def _size(text: str) -> str:
    """One that both engines can have."""
    try:
        size = size_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if size.polygons <= FIXED_POLYGONS:
        raise argparse.ArgumentTypeError(f"size is {text}: the scenes need a polygon more than the scenery's")
    return text


def _race(run: Callable[[argparse.Namespace], Result], given: argparse.Namespace) -> None:
    result = run(given)
    if given.json:
        write_json(result, sys.stdout)
    else:
        write_table(result)


def parity(given: argparse.Namespace) -> None:
    """Both engines in turns, this one in this process."""
    if given.level_file is not None and len(given.size) > 1:
        raise UserError("--level-file has levels of one size: give that one as --size.")
    prepare_jax()
    from benchmarks.parity.campaign import campaign  # compiles functions as it is imported
    from benchmarks.parity.progress import Board
    from benchmarks.parity.report import Report

    python = oracle.oracle_python()
    with Board(Console(stderr=True)).shown() as board:
        of = (given.states, given.episodes, board, given.level_file, given.keep)
        sizes = [campaign(python, size, *of) for size in given.size]
    settings = {"states": given.states, "episodes": given.episodes, "stickiness": STICKINESS}
    report = Report.of(sizes, settings, oracle.versions(python))
    if given.json:
        report.write_json(sys.stdout)
    else:
        report.write_tables()
    report.check()


def physics(given: argparse.Namespace) -> Result:
    """The engine and the task's rules."""
    python = oracle.oracle_python()
    with tempfile.TemporaryDirectory() as folder:
        actions = Path(folder) / "actions.npy"
        np.save(actions, sticky_actions(given.steps, given.lanes))
        levels = given.level_file or oracle.sampled_levels(python, given.size)
        files = ["--levels", levels, "--actions", actions]
        steps = given.lanes * given.steps
        cores = own_cores()

        def entry(name: str, script: list[object], places: list[tuple[int | None, int, int]]) -> Entry:
            commands = [
                [*script, *files, "--first", first, "--lanes", count, *_on(core)] for core, first, count in places
            ]
            return Entry(name, _words(commands), _environment(name), steps)

        ours = [sys.executable, "-m", "benchmarks.race.ours_physics", "--block", given.block]
        theirs = [python, oracle.SCRIPTS / "physics.py", "--size", given.size]
        theirs += ["--block", given.reference_block or given.lanes]
        shared = share(given.lanes, cores)
        entries = [entry(OURS, ours, shared), entry(PINNED, theirs, shared)]
        if len(cores) > 1:
            entries.append(entry(FREE, theirs, [(None, 0, given.lanes)]))
        scores = compete(entries, given.repeats)
    settings = {"lanes": given.lanes, "steps": given.steps, "block": given.block}
    settings |= {"reference_block": given.reference_block or given.lanes, "stickiness": STICKINESS}
    return summary("physics", given.size, settings, scores, oracle.versions(python))


def experts(given: argparse.Namespace) -> Result:
    """Training."""
    python = oracle.oracle_python()
    levels = given.level_file or oracle.sampled_levels(python, given.size)
    settings = {name: getattr(given, name) for name in ("levels", "environments", "horizon", "updates")}
    shape: list[object] = ["--levels", levels]
    for name in ("environments", "horizon", "updates"):
        shape += [f"--{name}", settings[name]]
    steps = given.levels * given.environments * given.horizon * given.updates
    cores = own_cores()

    def entry(name: str, script: list[object], places: list[tuple[int | None, int, int]]) -> Entry:
        commands = [[*script, *shape, "--first", first, "--count", count, *_on(core)] for core, first, count in places]
        return Entry(name, _words(commands), _environment(name), steps)

    theirs = [python, oracle.SCRIPTS / "experts.py", "--size", given.size]
    shared = share(given.levels, cores)
    entries = [
        entry(OURS, [sys.executable, "-m", "benchmarks.race.ours_experts"], shared),
        entry(PINNED, theirs, shared),
    ]
    if len(cores) > 1:
        entries.append(entry(FREE, theirs, [(None, 0, given.levels)]))
    return summary("experts", given.size, settings, compete(entries, given.repeats), oracle.versions(python))


def share(count: int, cores: Sequence[int]) -> list[tuple[int | None, int, int]]:
    """(core, first, how many) of each process, as even as can be; cores without work are left out."""
    cuts = np.linspace(0, count, min(len(cores), count) + 1).round().astype(int).tolist()
    return [(core, a, b - a) for core, a, b in zip(cores, cuts, cuts[1:], strict=False)]


def _on(core: int | None) -> list[object]:
    return [] if core is None else ["--core", core]


def _words(commands: Sequence[Sequence[object]]) -> list[list[str]]:
    return [[str(word) for word in command] for command in commands]


def _environment(name: str) -> dict[str, str]:
    """Of a contestant's processes. Ours finds the packages wherever they were imported from."""
    if name != OURS:
        return dict(oracle.environment())
    root = str(Path(benchmarks.__file__).parent.parent)
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
    return dict(os.environ) | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
