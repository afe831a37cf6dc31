"""`levelproof inspect`: show the contents of a split."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_json, add_split, row_count
from levelproof.pipeline.errors import UserError

SUMMARY = "show the contents of a split"
EXAMPLE = """\
levelproof inspect data/128k/s --where "label = 'solved' AND steps_to_goal < 64"
levelproof inspect data/128k/s --columns level_id,env_steps --sort "env_steps DESC" --limit 20
levelproof inspect data/128k/s --plot split.svg"""
WHERE = "count only rows that meet this condition on the manifest's columns"
AGAINST = "look for the same levels in another split, a level file, or a folder of them (may be repeated)"
COLUMNS = "comma-separated columns to show (default: a few on screen, else all)"
SORT = "column or SQL expression to sort by; append DESC for largest first (default: level_id)"
IGNORED = {"csv": ("against",), "plot": ("against", "columns", "sort", "limit")}  # options by output
LIMIT = "number of rows, and of duplicate pairs, to show (default: 10; with --csv all)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("--where", metavar="SQL", help=WHERE)
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="PATH", help=AGAINST)
    parser.add_argument("--columns", metavar="NAMES", help=COLUMNS)
    parser.add_argument("--sort", metavar="SQL", help=SORT)
    parser.add_argument("--limit", "--rows", type=row_count, metavar="COUNT", help=LIMIT)
    output = parser.add_mutually_exclusive_group()
    add_json(output)
    output.add_argument("--csv", action="store_true", help="print only the rows, as CSV")
    output.add_argument("--plot", type=Path, metavar="FILE", help="draw histograms and learning curves: .svg or .png")


def run(arguments: argparse.Namespace) -> None:
    import sys

    from levelproof.pipeline.look.query import RowQuery, write_csv

    names = arguments.columns.split(",") if arguments.columns else None
    columns = names and list(dict.fromkeys(name.strip() for name in names))
    _require_effect(arguments)
    query = RowQuery(arguments.where, columns, arguments.sort, arguments.limit)
    if arguments.csv:
        return write_csv(arguments.split, query, sys.stdout)
    if arguments.plot:
        from levelproof.pipeline.look.plot import plot

        return plot(arguments.split, query, arguments.plot)
    from levelproof.pipeline.look.inspect import inspect

    return inspect(arguments.split, query, arguments.json, arguments.against)


def _require_effect(arguments: argparse.Namespace) -> None:
    """Raise UserError for an option that the chosen output ignores."""
    for output, ignored in IGNORED.items():
        for name in ignored:
            if getattr(arguments, output) and getattr(arguments, name):
                raise UserError(f"--{name} has no effect with --{output}: leave one of them out.")
