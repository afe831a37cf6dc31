"""`levelproof verify`: check a split, and repair it."""

import argparse

from levelproof.pipeline.cli.command import add_json, add_split
from levelproof.pipeline.errors import Exit

SUMMARY = "check every byte of a split, regenerate every level, replay every witness"
EXAMPLE = """\
levelproof verify data/128k/s
levelproof verify data/128k/s --repair"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    mode = parser.add_mutually_exclusive_group()
    add_json(mode)
    mode.add_argument(
        "--repair",
        nargs="*",
        metavar="NAME=VALUE",
        help="remake what is damaged or missing, and nothing else; settings: executor, workers, unit and "
        "device, as for generate",
    )


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.store.remote import require_folder

    if arguments.repair is not None:
        require_folder(arguments.split, "repair it")
        from levelproof.pipeline.jobs.repair import repair

        return repair(arguments.split, arguments.repair, Console(stderr=True))
    from levelproof.pipeline.verify.verify import verify

    return verify(arguments.split, arguments.json, Console(stderr=True))
