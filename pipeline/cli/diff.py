"""`levelproof diff`: compare the same levels in two splits."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import SPLIT, add_json, row_count

SUMMARY = "compare two splits of the same levels: which are solved, at what cost"
EXAMPLE = "levelproof diff data/128k/s data/256k/s"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, metavar="SPLIT", help=SPLIT)
    parser.add_argument("other", type=Path, metavar="OTHER", help="another split of the same levels")
    where = "compare only levels that meet this condition on the first manifest's columns"
    parser.add_argument("--where", metavar="SQL", help=where)
    rows = "number of levels to list that only one split solved (default: 10)"
    parser.add_argument("--rows", type=row_count, default=10, help=rows)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.diff import diff

    diff(arguments.split, arguments.other, arguments.where, arguments.rows, arguments.json)
