"""`levelproof verify`: check a split, and repair it."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_json, add_split, parted
from levelproof.pipeline.errors import Exit, UserError
from levelproof.pipeline.urls import require_known

SUMMARY = "check every byte of a split, regenerate every level, replay every witness"
EXAMPLE = """\
levelproof verify data/128k/s
levelproof verify data/128k/s --repair"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser, optional=True)
    mode = parser.add_mutually_exclusive_group()
    add_json(mode)
    mode.add_argument(
        "--repair",
        nargs="*",
        metavar="NAME=VALUE",
        help="remake what is damaged or missing, and nothing else; settings: executor, workers, unit and "
        "device, as for generate",
    )


def run(arguments: argparse.Namespace) -> Exit:
    from rich.console import Console

    split, settings = (arguments.split, arguments.repair) if arguments.split else _split_in(arguments.repair or [])
    from levelproof.pipeline.store.remote import require_folder

    if settings is not None:
        require_folder(split, "repair it")
        from levelproof.pipeline.jobs.repair import repair

        return repair(split, settings, Console(stderr=True))
    from levelproof.pipeline.verify.verify import verify

    return verify(split, arguments.json, Console(stderr=True))


def _split_in(words: list[str]) -> tuple[Path, list[str]]:
    """Return the split, and the settings, among the words after --repair, which takes all of them."""
    splits, settings = parted(words)
    if len(splits) > 1:
        raise UserError(f"Verify one split at a time: name one, not {len(splits)}.")
    if not splits:
        raise UserError("No split was given: name one, as in `levelproof verify data/128k/s`.")
    require_known(splits[0])
    return splits[0], settings
