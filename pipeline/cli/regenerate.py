"""`levelproof regenerate`: train a manifest's levels at another budget."""

import argparse

from levelproof.pipeline.errors import Exit

SUMMARY = "train a manifest's levels at another budget"
EXAMPLE = "levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\""
ARGUMENTS = (
    "manifest=SPLIT and budget=N; where=SQL: only levels that meet this condition on the manifest's columns; "
    "continue=true: resume the experts that the split kept (keep_experts=true); and any setting of generate, such as "
    "out=NAME"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help=ARGUMENTS)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.jobs.regenerate import regenerate

    return regenerate(arguments.words, Console(stderr=True))
