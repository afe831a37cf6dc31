"""`levelproof status`: how far a split is."""

import argparse

from pipeline.cli.command import Commands, add_command, add_json, add_split
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(commands, "status", run, "tell how far a split is", "levelproof status data/128k/s")
    add_split(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.look.status import status

    status(arguments.split, arguments.json)
    return Exit.DONE
