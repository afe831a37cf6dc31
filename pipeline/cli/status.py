"""`levelproof status`: how far a split is."""

import argparse

from pipeline.cli.command import add_json, add_split

DOES = "tell how far a split is"
EXAMPLE = "levelproof status data/128k/s"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from pipeline.look.status import status

    status(arguments.split, arguments.json)
