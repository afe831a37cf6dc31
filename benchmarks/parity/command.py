"""The words of `python -m benchmarks parity`."""

import argparse
from pathlib import Path

from rich.console import Console

from benchmarks import oracle, race
from benchmarks.parity.progress import Board
from benchmarks.reference.actions import STICKINESS
from benchmarks.report import Report
from levelproof.levelgen.level import size_of
from levelproof.physics.types import FIXED_POLYGONS
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import prepare_jax

CUSTOM = "8-8-8-4"  # a size without a name


def register(parser: argparse.ArgumentParser) -> None:
    sizes = ["s", "m", "l", CUSTOM]
    text = f"of the worlds: s, m, l or POLYGONS-CIRCLES-JOINTS-THRUSTERS (default: {' '.join(sizes)})"
    parser.add_argument("--size", nargs="+", type=size, default=sizes, help=text)
    text = "states a size to take one step from (default: 10,000)"
    parser.add_argument("--states", type=int, default=10_000, help=text)
    text = "levels with actions to play, a size (default: 1,000)"
    parser.add_argument("--episodes", type=int, default=1_000, help=text)
    parser.add_argument("--keep", type=Path, help="folder for the reference's answers: next time only our side runs")
    parser.add_argument("--level-file", type=Path, help="levels as the reference's arrays (default: it samples some)")


def size(text: str) -> str:
    """One that both engines can have."""
    try:
        found = size_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if found.polygons <= FIXED_POLYGONS:
        raise argparse.ArgumentTypeError(f"size is {text}: the scenes need a polygon more than the scenery's")
    return text


def run(args: argparse.Namespace) -> Report:
    """Both engines in turns, this one in this process."""
    race.check(args, ("states", "episodes"))
    if args.level_file is not None and len(args.size) > 1:
        raise UserError("--level-file has levels of one size: give that one as --size.")
    prepare_jax()
    from benchmarks.parity.campaign import campaign  # compiles functions as it is imported
    from benchmarks.parity.report import report_of

    python = oracle.oracle_python()
    board = Board(Console(stderr=True))
    with board.shown():
        of = (args.states, args.episodes, board, args.level_file, args.keep)
        sizes = [campaign(python, size, *of) for size in args.size]
    settings = {"states": args.states, "episodes": args.episodes, "stickiness": STICKINESS}
    return report_of(sizes, settings, oracle.versions(python))
