"""`levelproof show`: a level as a film or a picture."""

import argparse
from pathlib import Path

from pipeline.cli.command import SPLIT, Commands, add_command
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "show",
        run,
        "draw a level's witness, or what doing nothing does",
        "levelproof show data/128k/s 7 -o level.gif",
    )
    parser.add_argument("source", type=Path, metavar="SPLIT", help=f"{SPLIT}; or a level file, such as level.json")
    parser.add_argument("level_id", type=int, nargs="?", metavar="LEVEL_ID", help="a level of the split")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("level.gif"),
        help="file to write: .gif, .mp4, .svg or .png (default: level.gif)",
    )


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.look.show import show

    show(arguments.source, arguments.level_id, arguments.out)
    return Exit.DONE
