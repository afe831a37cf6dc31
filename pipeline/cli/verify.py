"""`levelproof verify`: whether a split is what it says."""

import argparse

from pipeline.cli.command import add_json, add_split
from pipeline.errors import Exit

DOES = "make every level of a split again, read every shard, replay every witness"
EXAMPLE = "levelproof verify data/128k/s"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> Exit:
    from pipeline.read.verify import verify
    from pipeline.store.remote import require_folder

    require_folder(arguments.split, "verify it")
    return verify(arguments.split, arguments.json)
