"""`levelproof seal`: merge many small files into few large ones."""

import argparse

from levelproof.pipeline.cli.command import add_split

SUMMARY = "merge a split's many small files into few large ones"
EXAMPLE = """levelproof seal data/128k/s
levelproof seal data/128k/s --density witness --key-every 16"""
ROWS = "approximate number of rows per sealed fragment (default: 100,000)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("--rows", type=int, metavar="N", help=ROWS)
    parser.add_argument("--density", choices=("full", "resume", "witness"), help="how much of each record to store")
    every = "env steps between key frames of --density witness (default: 32)"
    parser.add_argument("--key-every", type=int, metavar="K", help=every)


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.schema import KEY_EVERY
    from levelproof.pipeline.errors import UserError
    from levelproof.pipeline.jobs.seal import seal_split

    every = arguments.key_every
    if every is not None and arguments.density != "witness":
        raise UserError("--key-every applies only to --density witness: add that, or leave --key-every out.")
    every = KEY_EVERY if every is None else every
    seal_split(arguments.split, arguments.rows, Console(stderr=True), arguments.density, every)
