"""`levelproof generate`: make levels and their experts."""

import argparse
import shutil

from levelproof.pipeline.cli.command import listed
from levelproof.pipeline.errors import Exit

SUMMARY = "make levels and their experts"
EXAMPLE = """\
levelproof generate                                 64 small levels into data
levelproof generate size=m levels=1k budget=1M      more levels, more training
levelproof generate distribution=vehicles out=cars  other levels
levelproof generate level_files=mine                levels of your own
levelproof generate stop.rule=budget expert.width=128    other experts"""
INDENT = 24  # column at which meanings start
# Settings that `generate --help` lists; `levelproof settings` lists all
COMMON = (
    "size",
    "distribution",
    "levels",
    "first_level",
    "budget",
    "procedure",
    "out",
    "keep_experts",
    "workers",
    "executor",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="settings to change")
    parser.format_help = lambda: _help(parser)


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    from levelproof.configs.compose import compose_job
    from levelproof.pipeline.jobs.generate import generate, generate_from_files

    job = compose_job(arguments.settings)
    make = generate_from_files if job.level_files else generate
    return make(job, ["levelproof", "generate", *arguments.settings], Console(stderr=True))


def _help(parser: argparse.ArgumentParser) -> str:
    """Return argparse's help with the common settings before the examples; fits on one screen."""
    from levelproof.configs.meanings import every_setting

    settings = {setting.name: setting for setting in every_setting()}
    entries = ((settings[name].override, settings[name].text) for name in COMMON)
    common = "\n".join(listed(entries, shutil.get_terminal_size().columns, INDENT))
    examples = parser.epilog
    parser.epilog = f"settings and their defaults (all of them: levelproof settings):\n{common}\n\n{examples}"
    try:
        return argparse.ArgumentParser.format_help(parser)
    finally:
        parser.epilog = examples
