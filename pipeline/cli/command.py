"""Arguments and text formatting that several commands share."""

import argparse
import os
import re
import textwrap
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from levelproof.pipeline.urls import SCHEME

EXITS = "exit codes: 0 done, 1 failed, 2 change the command,\n            3 some units quarantined, 130 interrupted"
SPLIT = "folder or URL of a split, such as data/128k/s or s3://bucket/data/128k/s"


def add_split(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    parser.add_argument("split", type=Path, metavar="SPLIT", help=SPLIT, nargs="?" if optional else None)


def add_out(parser: argparse.ArgumentParser, default: str, kinds: str = "") -> None:
    text = f"file to write{kinds} (default: {default})"
    parser.add_argument("-o", "--out", type=Path, default=Path(default), help=text)


def add_json(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def row_count(text: str) -> int:
    """Parse a number of rows to show. Raises ArgumentTypeError, which argparse reports."""
    if not re.fullmatch(r"\d{1,9}", text):
        raise argparse.ArgumentTypeError(f"{text} is not a number of rows: use 0 to 999999999")
    return int(text)


def parted(words: Collection[str]) -> tuple[list[Path], list[str]]:
    """Separate a command's arguments into splits and settings; one with "=" is a split if it exists or is a URL."""
    # Unlike Path.exists, os.path.exists does not raise for a word that is too long for a path, such as a list of ids
    settings = [word for word in words if "=" in word and not (SCHEME.match(word) or os.path.exists(word))]
    return [Path(word) for word in words if word not in settings], settings


def listed(entries: Iterable[tuple[str, str]], columns: int, indent: int) -> Iterator[str]:
    """Yield lines of names and, from column `indent` on, their meanings, wrapped at `columns` characters."""
    for name, meaning in entries:
        first = f"  {name}  "
        lines = textwrap.wrap(meaning, max(columns - indent, indent))
        if len(first) > indent:
            yield first.rstrip()
        else:
            yield f"{first:{indent}}{lines.pop(0)}"
        yield from (" " * indent + line for line in lines)
