"""`levelproof grow`: make a split from seed files."""

import argparse
from pathlib import Path

from levelproof.pipeline.errors import Exit

SUMMARY = "make a split from seed files, with every witness replayed and checked"
EXAMPLE = """\
levelproof grow levels.parquet -o grown/256k/s
levelproof grow seeds/256k/s -o grown/256k/s density=witness executor=inline"""
SEEDS = "a seed file that `export --format seed` wrote (path or URL), or a folder of them"
OUT = "the split to make or continue: FOLDER/BUDGET/SIZE, with the seeds' budget and size"
SETTINGS = "density=, key_every=, executor= or workers=, as for generate"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("seeds", type=Path, metavar="SEEDS", help=SEEDS)
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help=SETTINGS)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="SPLIT", help=OUT)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.jobs.grow import grow

    return grow(arguments.seeds, arguments.out, arguments.words, Console(stderr=True))
