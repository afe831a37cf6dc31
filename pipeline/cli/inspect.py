"""`levelproof inspect`: what is in a split."""

import argparse
from pathlib import Path

from pipeline.cli.command import add_json, add_split

DOES = "show what is in a split"
EXAMPLE = "levelproof inspect data/128k/s --where \"label = 'solved' AND steps_to_goal < 64\""
WHERE = "count only rows for which this condition on the manifest's columns holds"
AGAINST = "look for the same levels in another split, a level file, or a folder of them (may be repeated)"
ROWS = "rows, and pairs of duplicates, to show (default: 10)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("--where", metavar="SQL", help=WHERE)
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="PATH", help=AGAINST)
    parser.add_argument("--rows", type=int, default=10, help=ROWS)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from pipeline.look.inspect import inspect

    inspect(arguments.split, arguments.where, arguments.rows, arguments.json, arguments.against)
