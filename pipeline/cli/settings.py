"""`levelproof settings`: list settings with their meanings, units and defaults."""

import argparse
import json
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from itertools import groupby
from typing import TYPE_CHECKING

from levelproof.pipeline.cli.command import add_json, listed
from levelproof.pipeline.errors import UserError

if TYPE_CHECKING:
    from levelproof.configs.meanings import Setting

SUMMARY = "list settings with their meanings, units and defaults"
EXAMPLE = "levelproof settings thruster"
INDENT = 34  # column at which meanings start
INTRODUCTION = """# Settings

Every setting of `levelproof generate` with its default, as typed on the command line: `levelproof generate size=m \
budget=64k`. `levelproof settings WORD` searches them. A name in brackets or parentheses is the field or function of \
the reference, Kinetix 3.0.2, that the value comes from. `levelproof settings --markdown` writes this page, from the \
comments on the dataclasses' fields.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("word", nargs="?", default="", metavar="WORD", help="only settings that contain this word")
    output = parser.add_mutually_exclusive_group()
    add_json(output)
    output.add_argument("--markdown", action="store_true", help="print the page docs/settings.md")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.configs.meanings import every_setting

    has_word = lambda text: arguments.word.lower() in text.lower()
    matching = [
        setting for setting in every_setting() if has_word(f"{setting.override} {setting.text} {setting.group}")
    ]
    if not matching:
        raise UserError(
            f"No setting contains the word {arguments.word!r}: levelproof settings, without a word, lists all."
        )
    if arguments.json:
        print(json.dumps([asdict(setting) for setting in matching], indent=2))
    elif arguments.markdown:
        print(as_markdown(matching), end="")
    else:
        print(as_text(matching, shutil.get_terminal_size().columns))


def as_text(settings: Iterable["Setting"], columns: int) -> str:
    """Format settings as text in two columns, by group."""
    groups = groupby(settings, lambda setting: setting.group)
    lines = lambda members: listed(((setting.override, setting.text) for setting in members), columns, INDENT)
    return "\n\n".join("\n".join([group, *lines(members)]) for group, members in groups)


def as_markdown(settings: Iterable["Setting"]) -> str:
    """Return the page docs/settings.md."""
    parts = [INTRODUCTION]
    for group, members in groupby(settings, lambda setting: setting.group):
        lines = [f"| `{setting.override}` | {setting.text} |" for setting in members]
        parts.append("\n".join([f"## {group}", "", "| setting and default | meaning |", "|---|---|", *lines, ""]))
    return "\n".join(parts)
