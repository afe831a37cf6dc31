"""`levelproof verify`: whether a split is what it says."""

import argparse

from pipeline.cli.command import Commands, add_command, add_json, add_split
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "verify",
        run,
        "make every level of a split again, read every shard, replay every witness",
        "levelproof verify data/128k/s",
    )
    add_split(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.read.verify import verify

    return verify(arguments.split, arguments.json)
