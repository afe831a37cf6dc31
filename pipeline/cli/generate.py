"""`levelproof generate`: levels and their experts."""

import argparse

from pipeline.cli.command import Commands, add_command
from pipeline.errors import Exit


def add(commands: Commands) -> None:
    parser = add_command(
        commands,
        "generate",
        run,
        "make levels and their experts",
        "levelproof generate size=m levels=32 budget=64k out=data",
        add_help=False,
    )
    parser.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="settings to change")
    parser.add_argument("-h", "--help", action="store_true", help="show this help and every setting")
    parser.set_defaults(parser=parser)


def run(arguments: argparse.Namespace) -> Exit:
    from configs.compose import compose_job, listing

    if arguments.help:
        arguments.parser.print_help()
        print(f"\nevery setting and its default:\n{listing()}")
        return Exit.DONE
    job = compose_job(arguments.settings)

    from rich.console import Console

    from pipeline.jobs.generate import generate

    return generate(job, ["levelproof", "generate", *arguments.settings], Console(stderr=True))
