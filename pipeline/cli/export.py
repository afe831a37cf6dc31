"""`levelproof export`: a level for other programs."""

import argparse

from pipeline.cli.command import add_out, add_split

DOES = "write a level as a file that Kinetix opens"
EXAMPLE = "levelproof export data/128k/s 7 -o level.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("level_id", type=int, metavar="LEVEL_ID", help="a level of the split")
    add_out(parser, "level.json")


def run(arguments: argparse.Namespace) -> None:
    from pipeline.read.export import export

    export(arguments.split, arguments.level_id, arguments.out)
