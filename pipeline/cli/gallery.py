"""`levelproof gallery`: write a split as a website."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_split

SUMMARY = "write a split as a website that browsers open from disk"
EXAMPLE = """\
levelproof gallery data/128k/s -o gallery/
levelproof gallery data/128k/s -o gallery/ --policy policy/ --levels 500"""
MAX_LEVELS = 100_000  # default


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    out = "folder to write; replaces an existing gallery (default: gallery)"
    parser.add_argument("-o", "--out", type=Path, default=Path("gallery"), help=out)
    parser.add_argument("--where", metavar="SQL", help="show only levels that meet this condition on columns")
    most = f"maximum number of levels to show, evenly spaced by id (default: {MAX_LEVELS})"
    parser.add_argument("--levels", type=int, default=MAX_LEVELS, metavar="COUNT", help=most)
    policy = "folder of a policy, or builtin:s or builtin:m, whose first attempt at each level plays beside the witness"
    parser.add_argument("--policy", type=Path, metavar="POLICY", help=policy)


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.gallery.gallery import gallery

    gallery(arguments.split, arguments.out, arguments.where, arguments.levels, arguments.policy)
