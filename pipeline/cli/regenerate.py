"""`levelproof regenerate`: a manifest's levels at another budget."""

import argparse

from pipeline.cli.command import Commands, add_command
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "regenerate",
        run,
        "train a manifest's levels at another budget",
        "levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\"",
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="NAME=VALUE",
        help="manifest=SPLIT and budget=N; where=SQL: only its levels for which this condition on the manifest's "
        "columns holds; continue=true: experts that the split has kept (keep_experts=true) go on; "
        "and any setting of generate, such as out=NAME",
    )


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from pipeline.jobs.regenerate import regenerate

    return regenerate(arguments.words, Console(stderr=True))
