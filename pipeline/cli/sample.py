"""`levelproof sample`: a sheet of random levels."""

import argparse
from pathlib import Path

from pipeline.cli.command import Commands, add_command
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "sample",
        run,
        "draw random levels, before anything is trained",
        "levelproof sample size=m distribution=clutter -o sheet.png",
    )
    parser.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="as for generate, but levels=15 by default")
    parser.add_argument("-o", "--out", type=Path, default=Path("sheet.png"), help="file to write (default: sheet.png)")


def run(arguments: argparse.Namespace) -> Exit:
    from configs.compose import compose_job
    from pipeline.look.sample import LEVELS, sample

    sample(compose_job([f"levels={LEVELS}", *arguments.settings]), arguments.out)
    return Exit.DONE
