"""`levelproof seal`: merge many small files into a few large ones."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_split

SUMMARY = "merge a split's many small files into a few large ones"
EXAMPLE = """levelproof seal data/128k/s
levelproof seal data/128k/s --density witness --key-every 16
levelproof seal data/128k/s --density seed -o levels.parquet    one file of ids and actions; the split stays"""
SEED = "seed"
ROWS = "approximate number of rows per sealed fragment (default: 100,000; at most 1,048,576)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("--rows", type=int, metavar="N", help=ROWS)
    density = "how much of each record to store; seed: in a file of its own, as export --format seed does"
    parser.add_argument("--density", choices=("full", "resume", "witness", SEED), help=density)
    every = "env steps between key frames of --density witness (default: 32)"
    parser.add_argument("--key-every", type=int, metavar="K", help=every)
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="the file to write, for --density seed")


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.schema import KEY_EVERY
    from levelproof.pipeline.errors import UserError
    from levelproof.pipeline.jobs.seal import seal_split

    every = arguments.key_every
    if every is not None and arguments.density != "witness":
        raise UserError("--key-every applies only to --density witness: add that, or leave --key-every out.")
    if arguments.density == SEED:
        return _seal_to_seed(arguments)
    if arguments.out is not None:
        raise UserError("-o applies only to --density seed: other densities are sealed in place, so leave it out.")
    every = KEY_EVERY if every is None else every
    return seal_split(arguments.split, arguments.rows, Console(stderr=True), arguments.density, every)


def _seal_to_seed(arguments: argparse.Namespace) -> None:
    """Write a seed file beside the split, which keeps what a seed leaves out: later episodes, costs and curves."""
    from levelproof.pipeline.errors import UserError
    from levelproof.pipeline.exchange.seed import export_seed

    if arguments.rows is not None:
        raise UserError("--rows does not apply to --density seed, which writes one file: leave it out.")
    if arguments.out is None:
        raise UserError(
            "--density seed leaves the split as it is: name the file to write with -o, as in -o levels.parquet."
        )
    export_seed(arguments.split, None, arguments.out)
