"""`levelproof status`: how far a split is."""

import argparse
import sys
from functools import partial

from levelproof.pipeline.cli.command import add_json, add_split

DOES = "tell how far a split is"
EXAMPLE = """levelproof status data/128k/s
levelproof status data/128k/s --watch"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    add_json(parser)
    parser.add_argument(
        "--watch", action="store_true", help="go on until no run is at work; with --json, a line a look"
    )


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.pipeline.look.status import status
    from levelproof.pipeline.look.watch import watch

    if arguments.watch:
        watch(arguments.split, arguments.json, Console(markup=False))
    else:
        status(arguments.split, arguments.json, partial(print, file=sys.stderr))
