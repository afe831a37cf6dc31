"""`levelproof show`: draw a level as a film or a picture."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import SPLIT, add_out

SUMMARY = "draw a level's witness or, without one, what happens without actions"
EXAMPLE = "levelproof show data/128k/s 7 -o level.gif"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="SPLIT", help=f"{SPLIT}; or a level file, such as level.json")
    parser.add_argument("level_id", type=int, nargs="?", metavar="LEVEL_ID", help="id of a level of the split")
    add_out(parser, "level.gif", ": .gif, .mp4, .svg or .png")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.show import show

    show(arguments.source, arguments.level_id, arguments.out)
