"""`levelproof regenerate`: a manifest's levels at another budget."""

import argparse

from levelproof.pipeline.errors import Exit

DOES = "train a manifest's levels at another budget"
EXAMPLE = "levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\""
WORDS = (
    "manifest=SPLIT and budget=N; where=SQL: only its levels for which this condition on the manifest's columns "
    "holds; continue=true: experts that the split has kept (keep_experts=true) go on; and any setting of generate, "
    "such as out=NAME"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help=WORDS)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.jobs.regenerate import regenerate

    return regenerate(arguments.words, Console(stderr=True))
