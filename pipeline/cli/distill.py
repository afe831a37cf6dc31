"""`levelproof distill`: train one policy on teachers' labels for states that it visits."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import parted
from levelproof.pipeline.errors import UserError

SUMMARY = "train one policy on teachers' labels for states that it visits"
EXAMPLE = """\
levelproof distill data/128k/s start=policy/ -o distilled/
levelproof distill masters/256k/s states=0 demonstrations=128 -o shown/"""
HELP = "a split (folder or URL), and settings to change as NAME=VALUE; docs/distill.md lists them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="+", metavar="SPLIT|NAME=VALUE", help=HELP)
    out = "folder to write; the same command continues a run that was stopped (default: distilled)"
    parser.add_argument("-o", "--out", type=Path, default=Path("distilled"), help=out)


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.compose import compose_distill
    from levelproof.pipeline.learn.distill import distill
    from levelproof.pipeline.urls import require_known

    splits, settings = parted(arguments.words)
    if len(splits) != 1:
        named = f"not {len(splits)}" if splits else "as in `levelproof distill data/128k/s`"
        raise UserError(f"Distilling takes the levels of one split: name one, {named}.")
    require_known(splits[0])
    distill(splits[0], compose_distill(settings), arguments.out, Console(stderr=True))
