"""`levelproof export`: a level for other programs."""

import argparse
from pathlib import Path

from pipeline.cli.command import Commands, add_command, add_split
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "export",
        run,
        "write a level as a file that Kinetix opens",
        "levelproof export data/128k/s 7 -o level.json",
    )
    add_split(parser)
    parser.add_argument("level_id", type=int, metavar="LEVEL_ID", help="a level of the split")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("level.json"), help="file to write (default: level.json)"
    )


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.read.export import export

    export(arguments.split, arguments.level_id, arguments.out)
    return Exit.DONE
