"""`levelproof export`: a level, or a split, for other programs."""

import argparse
from collections.abc import Callable
from pathlib import Path

from levelproof.pipeline.cli.command import add_split
from levelproof.pipeline.errors import UserError

DOES = "write levels and their witnesses for other programs"
EXAMPLE = """\
levelproof export data/128k/s 7 -o level.json          a level that Kinetix opens
levelproof export data/128k/s --format kinetix -o k    a data set that Kinetix' reader opens
levelproof export data/128k/s --format kinetix -o k --where "steps_to_goal < 64"
levelproof export data/128k/s --format minari -o m     a data set of offline RL
levelproof export data/128k/s --format parquet -o t    levels and manifest as a table"""
JSON = "json"  # one level; all others take a split
WHERE = (
    "only levels for which this condition on the manifest's columns holds "
    "(default: label = 'solved'; of parquet, every level)"
)


def _kinetix(split: Path, where: str | None, out: Path) -> None:
    from levelproof.pipeline.exchange.kinetix import export_kinetix

    export_kinetix(split, where, out)


def _parquet(split: Path, where: str | None, out: Path) -> None:
    from levelproof.pipeline.exchange.parquet import export_parquet

    export_parquet(split, where, out)


def _minari(split: Path, where: str | None, out: Path, actions: str = "multi_discrete") -> None:
    from levelproof.pipeline.exchange.minari.episodes import ActionKind
    from levelproof.pipeline.exchange.minari.export import export_minari

    export_minari(split, where, out, ActionKind(actions))


# What writes the levels of a split for which a condition holds (None: each format's own) to a new file or folder
FORMATS: dict[str, Callable[..., None]] = {"kinetix": _kinetix, "minari": _minari, "parquet": _parquet}
ACTIONS = (
    "multi_discrete",
    "combined",
    "continuous",
)  # of pipeline.exchange.minari.episodes.ActionKind, without importing it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument("level_id", type=int, nargs="?", metavar="LEVEL_ID", help=f"a level of the split, for {JSON}")
    parser.add_argument("--format", choices=(JSON, *FORMATS), default=JSON, help=f"what to write (default: {JSON})")
    parser.add_argument("--where", metavar="SQL", help=WHERE)
    parser.add_argument("--actions", choices=ACTIONS, help=f"how minari has actions (default: {ACTIONS[0]})")
    parser.add_argument("-o", "--out", type=Path, help=f"file or folder to write (default, of {JSON}: level.json)")


def run(arguments: argparse.Namespace) -> None:
    split, level_id, where, out = arguments.split, arguments.level_id, arguments.where, arguments.out
    if arguments.actions and arguments.format != "minari":
        raise UserError(f"--actions is for --format minari: leave it out for {arguments.format}.")
    if arguments.format == JSON:
        if level_id is None or where is not None:
            raise UserError(
                f"As {JSON} one level is exported: give its id, as in levelproof export {split} 7, without --where; "
                f"--format chooses one of {', '.join(FORMATS)} for many."
            )
        from levelproof.pipeline.exchange.level_json import export

        export(split, level_id, out or Path("level.json"))
        return
    if level_id is not None:
        raise UserError(
            f"The format {arguments.format} is for a split, not for level {level_id} alone: "
            f'choose levels with --where, as in --where "level_id = {level_id}".'
        )
    if out is None:
        raise UserError(f"Where to? Name what to write with -o, as in -o {arguments.format}.")
    FORMATS[arguments.format](split, where, out, *filter(None, [arguments.actions]))
