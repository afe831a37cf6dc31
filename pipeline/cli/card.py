"""`levelproof card`: write a dataset's page for the Hugging Face hub."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import SPLIT

SUMMARY = "write the README of a dataset of splits, for the Hugging Face hub"
EXAMPLE = """\
levelproof card data/1M/s data/1M/m --license cc-by-4.0 --repo me/levels"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("splits", type=Path, nargs="+", metavar="SPLIT", help=SPLIT)
    where = "file to write (default: README.md in the folder above {budget}/); local splits must be below its folder"
    parser.add_argument("-o", "--out", type=Path, help=where)
    parser.add_argument("--license", metavar="ID", help="the data's licence by its name on the hub, such as cc-by-4.0")
    parser.add_argument("--name", help="the dataset's name (default: that of its folder)")
    parser.add_argument("--repo", metavar="USER/NAME", help="name of the dataset on the hub")
    parser.add_argument("--code", metavar="URL", help="address of the code that made the dataset")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.look.card import card
    from levelproof.pipeline.look.readme import CardOptions

    options = CardOptions(arguments.license, arguments.name, arguments.repo, arguments.code)
    card(arguments.splits, arguments.out, options)
