"""`levelproof import`: make a split of another program's trajectories."""

import argparse
from pathlib import Path

from levelproof.pipeline.errors import Exit

SUMMARY = "make a split from trajectories in Kinetix's format"
EXAMPLE = "levelproof import kinetix/1M/s -o data/1M/s"
FOLDER = "a zarr v2 group of trajectories, as in the released data or from export --format kinetix"
OUT = "the split to make or continue: FOLDER/BUDGET/SIZE, where BUDGET is the budget of the imported experts"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help=FOLDER)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="SPLIT", help=OUT)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.jobs.imported import import_folder

    return import_folder(arguments.folder, arguments.out, Console(stderr=True))
