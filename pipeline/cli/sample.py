"""`levelproof sample`: draw a sheet of random levels."""

import argparse

from levelproof.pipeline.cli.command import add_out
from levelproof.pipeline.errors import UserError

SUMMARY = "draw random levels without training experts"
EXAMPLE = "levelproof sample size=m distribution=clutter -o sheet.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "settings", nargs="*", metavar="NAME=VALUE", help="settings as for generate, but levels=15 by default"
    )
    add_out(parser, "sheet.png")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.configs.compose import compose_job
    from levelproof.pipeline.look.sample import LEVELS, sample

    if any(setting.startswith("level_files=") for setting in arguments.settings):
        raise UserError("sample draws random levels: draw a level file with `levelproof show level.json -o level.svg`.")
    sample(compose_job([f"levels={LEVELS}", *arguments.settings]), arguments.out)
