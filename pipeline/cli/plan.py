"""`levelproof plan`: estimate the cost of a job."""

import argparse

from levelproof.pipeline.cli.command import add_json

SUMMARY = "estimate the hours, bytes, files and solved levels of a job"
EXAMPLE = """levelproof plan size=s levels=6M budget=256k
levelproof plan size=m levels=1M budget=1M workers=64"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="settings as for generate")
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.compose import compose_job
    from levelproof.pipeline.jobs.plan import plan

    plan(compose_job(arguments.settings), arguments.json, Console(stderr=True))
