"""`levelproof import`: another program's trajectories as a split."""

import argparse
from pathlib import Path

from levelproof.pipeline.errors import Exit

DOES = "make a split of trajectories in Kinetix' own layout"
EXAMPLE = "levelproof import kinetix/1M/s -o data/1M/s"
FOLDER = "a zarr v2 group of trajectories, such as one of the released data or of export --format kinetix"
OUT = "the split to make or to go on with: FOLDER/BUDGET/SIZE, the budget being what experts there could use"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help=FOLDER)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="SPLIT", help=OUT)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.pipeline.jobs.imported import import_folder

    return import_folder(arguments.folder, arguments.out, Console(stderr=True))
