"""`levelproof generate`: levels and their experts."""

import argparse
import shutil

from pipeline.cli.command import Commands, add_command
from pipeline.errors import Exit

EXAMPLES = """\
levelproof generate                                 64 small levels into data
levelproof generate size=m levels=1k budget=1M      more, larger, for longer
levelproof generate distribution=vehicles out=cars  other levels
levelproof generate stop=budget expert.width=128    other experts"""
INDENT = 24  # where meanings start
# What people change; `levelproof settings` has the others
OFTEN = (
    "size",
    "distribution",
    "levels",
    "first_level",
    "budget",
    "stop",
    "out",
    "keep_experts",
    "workers",
    "executor",
)


def add(commands: Commands) -> None:
    parser = add_command(commands, "generate", run, "make levels and their experts", EXAMPLES, add_help=False)
    parser.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="settings to change")
    parser.add_argument("-h", "--help", action="store_true", help="show this help message and exit")
    parser.set_defaults(parser=parser)


def run(arguments: argparse.Namespace) -> Exit:
    if arguments.help:
        return _help(arguments.parser)

    from rich.console import Console

    from configs.compose import compose_job
    from pipeline.jobs.generate import generate

    job = compose_job(arguments.settings)
    return generate(job, ["levelproof", "generate", *arguments.settings], Console(stderr=True))


def _help(parser: argparse.ArgumentParser) -> Exit:
    """argparse's help, with the settings that people change before the examples: on one screen."""
    from configs.meanings import every_setting
    from pipeline.cli.settings import rows

    settings = {setting.name: setting for setting in every_setting()}
    often = "\n".join(rows((settings[name] for name in OFTEN), shutil.get_terminal_size().columns, INDENT))
    parser.epilog = f"settings and their defaults (all of them: levelproof settings):\n{often}\n\n{parser.epilog}"
    parser.print_help()
    return Exit.DONE
