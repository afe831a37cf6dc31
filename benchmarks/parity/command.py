"""Command line of `python -m benchmarks parity`."""

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
    text = f"size of the worlds: s, m, l or POLYGONS-CIRCLES-JOINTS-THRUSTERS (default: {' '.join(sizes)})"
    parser.add_argument("--size", nargs="+", type=size, default=sizes, help=text)
    text = "states per size to step from (default: 10,000)"
    parser.add_argument("--states", type=int, default=10_000, help=text)
    text = "episodes per size to play (default: 1,000)"
    parser.add_argument("--episodes", type=int, default=1_000, help=text)
    parser.add_argument(
        "--keep", type=Path, help="folder that keeps the reference's answers: later runs need only our side"
    )
    parser.add_argument("--level-file", type=Path, help="levels as the reference's arrays (default: it samples some)")


def size(text: str) -> str:
    """Check that both engines support a size."""
    try:
        parsed = size_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if parsed.polygons <= FIXED_POLYGONS:
        raise argparse.ArgumentTypeError(f"size is {text}: scenes need at least one polygon beside the scenery's")
    return text


def run(args: argparse.Namespace) -> Report:
    """Run both engines in turns, ours in this process."""
    race.check(args, ("states", "episodes"))
    if args.level_file is not None and len(args.size) > 1:
        raise UserError("--level-file has levels of one size: pass that one as --size.")
    prepare_jax()
    from benchmarks.parity.campaign import campaign  # compiles functions on import
    from benchmarks.parity.report import report_of

    python = oracle.oracle_python()
    board = Board(Console(stderr=True))
    with board.shown():
        options = (args.states, args.episodes, board, args.level_file, args.keep)
        sizes = [campaign(python, size, *options) for size in args.size]
    settings = {"states": args.states, "episodes": args.episodes, "stickiness": STICKINESS}
    return report_of(sizes, settings, oracle.versions(python))
