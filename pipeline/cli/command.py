"""What the commands share: how each registers itself, and the words they use alike."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

EXITS = "exit codes: 0 done, 1 failed, 2 change the command, 3 some units quarantined"
SPLIT = "folder of a split, such as data/128k/s"


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    does: str,
    example: str,
    **options: Any,
) -> argparse.ArgumentParser:
    """The parser of a new command, still without arguments of its own.

    Args:
        commands: where it is added.
        name: what people type.
        run: does it and gives an exit code; imports what it needs, so that other commands need not wait.
        does: one line of help, without a capital and a full stop.
        example: of the command, or several of them, one a line.
        options: further ones of ArgumentParser.
    """
    examples = example.splitlines()
    head = f"example: {example}" if len(examples) == 1 else "\n  ".join(["examples:", *examples])
    parser = commands.add_parser(
        name,
        help=does,
        description=f"{does[0].upper()}{does[1:]}.",
        epilog=f"{head}\n{EXITS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **options,
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.set_defaults(run=run)
    return parser


def add_split(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, metavar="SPLIT", help=SPLIT)


def add_json(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")
