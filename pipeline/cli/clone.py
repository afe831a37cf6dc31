"""`levelproof clone`: train one policy for all levels on the witnesses of splits."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import parted
from levelproof.pipeline.errors import UserError

SUMMARY = "train one policy for all levels on the witnesses of splits"
EXAMPLE = """\
levelproof clone manifests/16k/s -o policy/ train.updates=3500
levelproof clone manifests/16k/s manifests/16k/m -o both/ train.updates=50k network.width=64"""
HELP = "splits (folders or URLs), and settings to change as NAME=VALUE; docs/train.md lists them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="+", metavar="SPLIT|NAME=VALUE", help=HELP)
    out = "folder to write; the same command continues a run that was stopped (default: policy)"
    parser.add_argument("-o", "--out", type=Path, default=Path("policy"), help=out)


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.compose import compose_clone
    from levelproof.pipeline.learn.clone import clone
    from levelproof.pipeline.urls import require_known

    splits, settings = parted(arguments.words)
    splits = list(dict.fromkeys(splits))
    if not splits:
        raise UserError("No split was given: name one, as in `levelproof clone data/128k/s`.")
    for split in splits:
        require_known(split)
    clone(splits, compose_clone(settings), arguments.out, Console(stderr=True))
