"""`levelproof inspect`: what is in a split."""

import argparse
from pathlib import Path

from pipeline.cli.command import Commands, add_command, add_json, add_split
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "inspect",
        run,
        "show what is in a split",
        "levelproof inspect data/128k/s --where \"label = 'solved' AND steps_to_goal < 64\"",
    )
    add_split(parser)
    parser.add_argument(
        "--where", metavar="SQL", help="count only rows for which this condition on the manifest's columns holds"
    )
    parser.add_argument(
        "--against",
        type=Path,
        action="append",
        default=[],
        metavar="PATH",
        help="look for the same levels in another split, a level file, or a folder of them (may be repeated)",
    )
    parser.add_argument("--rows", type=int, default=10, help="rows, and pairs of duplicates, to show (default: 10)")
    add_json(parser)


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.look.inspect import inspect

    inspect(arguments.split, arguments.where, arguments.rows, arguments.json, arguments.against)
    return Exit.DONE
