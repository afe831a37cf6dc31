"""`levelproof status`: show the progress of a split."""

import argparse
import sys
from functools import partial

from levelproof.pipeline.cli.command import add_json, add_split

SUMMARY = "show the progress of a split"
EXAMPLE = """levelproof status data/128k/s
levelproof status data/128k/s --watch"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    add_json(parser)
    parser.add_argument(
        "--watch",
        action="store_true",
        help="refresh until no run is active, every 2 s (tables in a file or pipe: 30 s); with --json, one line each",
    )


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.status import status
    from levelproof.pipeline.look.watch import watch
    from levelproof.pipeline.tables import console_for_tables

    if arguments.watch:
        watch(arguments.split, arguments.json, console_for_tables())
    else:
        status(arguments.split, arguments.json, partial(print, file=sys.stderr))
