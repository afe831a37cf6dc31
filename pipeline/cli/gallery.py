"""`levelproof gallery`: a split as a site to look at."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_split

DOES = "write a split as a site that browsers open from the disk"
EXAMPLE = "levelproof gallery data/128k/s -o gallery/"
MOST = 100_000  # levels, if the command does not say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    out = "folder to write; a gallery that is there is replaced (default: gallery)"
    parser.add_argument("-o", "--out", type=Path, default=Path("gallery"), help=out)
    parser.add_argument("--where", metavar="SQL", help="show only levels for which this condition on columns holds")
    most = f"show at most so many levels, spread evenly over their ids (default: {MOST})"
    parser.add_argument("--levels", type=int, default=MOST, metavar="COUNT", help=most)


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.gallery.gallery import gallery

    gallery(arguments.split, arguments.out, arguments.where, arguments.levels)
