"""`levelproof columns`: list a manifest's columns with their meanings, types and units."""

import argparse
import json
import shutil
from typing import TYPE_CHECKING

from levelproof.pipeline.cli.command import add_json, listed
from levelproof.pipeline.errors import UserError

if TYPE_CHECKING:
    from levelproof.pipeline.store.columns import ManifestColumn

SUMMARY = "list a manifest's columns with their meanings, types and units"
EXAMPLE = "levelproof columns steps"
INDENT = 26  # column at which meanings start
INTRODUCTION = """# Columns

Every column of a manifest, version {version}, which has one row for every level that was tried. Use these names in \
`--where`, `--columns` and `--sort`, in `levelproof.open(where=...)`, and in any program that reads parquet. \
`levelproof columns WORD` searches them. A rate or number that does not exist is null, never NaN, so comparisons skip \
it.

| column | type, unit | meaning |
|---|---|---|
"""
END = """
`seconds` and `versions` are structs: in SQL, write `seconds.training` and `versions.jax`.

More on [labels](labels.md) and their evidence, [content hashes and signatures](levels.md), \
[portability](experts.md), and [seconds, shards and rows](storage.md). `levelproof columns --markdown` writes this \
page, from `pipeline/store/columns.py`.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("word", nargs="?", default="", metavar="WORD", help="only columns that contain this word")
    output = parser.add_mutually_exclusive_group()
    add_json(output)
    output.add_argument("--markdown", action="store_true", help="print the page docs/columns.md")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.store.columns import DESCRIBED

    text = lambda column: f"{column.name} {column.type_name} {column.unit} {column.meaning}".lower()
    matching = [column for column in DESCRIBED if arguments.word.lower() in text(column)]
    if not matching:
        raise UserError(
            f"No column contains the word {arguments.word!r}: levelproof columns, without a word, lists all."
        )
    if arguments.json:
        print(json.dumps([column._asdict() | {"type": column.type_name} for column in matching], indent=2))
    elif arguments.markdown:
        print(as_markdown(), end="")
    else:
        print(*listed(map(_entry, matching), shutil.get_terminal_size().columns, INDENT), sep="\n")


def _entry(column: "ManifestColumn") -> tuple[str, str]:
    return column.name, f"{column.text} ({_type_and_unit(column)})"


def _type_and_unit(column: "ManifestColumn") -> str:
    return ", ".join(filter(None, [column.type_name, column.unit]))


def as_markdown() -> str:
    """Return the page docs/columns.md."""
    from levelproof.pipeline.store.columns import DESCRIBED, MANIFEST_VERSION

    rows = [f"| `{column.name}` | {_type_and_unit(column)} | {column.text} |" for column in DESCRIBED]
    return INTRODUCTION.format(version=MANIFEST_VERSION) + "\n".join(rows) + "\n" + END
