"""`levelproof export`: write a level or a split for other programs."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_split
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.urls import quoted

SUMMARY = "write levels and their witnesses for other programs"
EXAMPLE = """\
levelproof export data/128k/s 7 -o level.json          a level that Kinetix opens
levelproof export data/128k/s --format kinetix -o k    a dataset that Kinetix' reader opens
levelproof export data/128k/s --format kinetix -o k --where "steps_to_goal < 64"
levelproof export data/128k/s --format minari -o m     a dataset for offline RL
levelproof export data/128k/s --format parquet -o t    a table of levels and manifest
levelproof export data/128k/s --format seed -o s.parquet    14 to 37 bytes per solved level
levelproof export manifests/256k/s-handmade --format seed --levels handmade -o handmade.parquet"""
JSON = "json"  # for one level; the other formats take a split
LEVEL = Path("level.json")  # its default
FORMATS = ("kinetix", "minari", "parquet", "seed")
ACTIONS = ("multi_discrete", "combined", "continuous")  # values of ActionKind, whose module is slow to import
WHERE = (
    "only levels that meet this condition on the manifest's columns "
    "(default: label = 'solved'; for parquet and seed, all levels)"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_split(parser)
    parser.add_argument(
        "level_id", type=int, nargs="?", metavar="LEVEL_ID", help=f"id of a level of the split, for {JSON}"
    )
    parser.add_argument("--format", choices=(JSON, *FORMATS), default=JSON, help=f"what to write (default: {JSON})")
    parser.add_argument("--where", metavar="SQL", help=WHERE)
    parser.add_argument("--actions", choices=ACTIONS, help=f"encoding of actions for minari (default: {ACTIONS[0]})")
    parser.add_argument(
        "--without-levels", action="store_true", help="leave levels that come from files out of a seed file"
    )
    parser.add_argument(
        "--levels", metavar="FOLDER",
        help="level files of the levels that a seed file lacks; `handmade`: those of the reference, "
        "even if a folder has that name",
    )  # fmt: skip
    parser.add_argument("-o", "--out", type=Path, help=f"file or folder to write (default for {JSON}: {LEVEL})")


def run(arguments: argparse.Namespace) -> None:
    split, level_id, where, out = arguments.split, arguments.level_id, arguments.where, arguments.out
    if arguments.actions and arguments.format != "minari":
        raise UserError(f"--actions is for --format minari: leave it out for {arguments.format}.")
    if (arguments.levels is not None or arguments.without_levels) and arguments.format != "seed":
        raise UserError("--levels and --without-levels are for --format seed: leave them out, or add --format seed.")
    if arguments.format == JSON:
        if level_id is None or where is not None:
            raise UserError(
                f"The format {JSON} is for one level: give its id, as in `levelproof export {quoted(split)} LEVEL_ID`, "
                f"without --where; for many levels, set --format to one of {', '.join(FORMATS)}."
            )
        from levelproof.pipeline.exchange.level_json import export

        if out is None and LEVEL.exists():
            raise UserError(f"{LEVEL} already exists: name the file to write with -o, as in -o level-{level_id}.json.")
        export(split, level_id, out or LEVEL)
        return
    if level_id is not None:
        raise UserError(
            f"The format {arguments.format} is for a split, not for level {level_id} alone: "
            f'select the level with --where, as in --where "level_id = {level_id}".'
        )
    if out is None:
        kind, name = ("file", "levels.parquet") if arguments.format == "seed" else ("folder", arguments.format)
        raise UserError(f"No output path: name the {kind} to write with -o, as in -o {name}.")
    match arguments.format:
        case "kinetix":
            from levelproof.pipeline.exchange.kinetix import export_kinetix

            export_kinetix(split, where, out)
        case "minari":
            from levelproof.pipeline.exchange.minari.episodes import ActionKind
            from levelproof.pipeline.exchange.minari.export import export_minari

            export_minari(split, where, out, ActionKind(arguments.actions or ACTIONS[0]))
        case "parquet":
            from levelproof.pipeline.exchange.parquet import export_parquet

            export_parquet(split, where, out)
        case "seed":
            _export_seed(split, where, out, arguments.levels, not arguments.without_levels)


def _export_seed(split: Path, where: str | None, out: Path, levels: str | None, with_levels: bool) -> None:
    if levels is None:
        from levelproof.pipeline.exchange.seed import export_seed

        export_seed(split, where, out, with_levels)
        return
    if where or not with_levels:
        raise UserError("--levels adds the levels to a whole seed file: leave out --where and --without-levels.")
    from levelproof.pipeline.exchange.levels_elsewhere import add_levels
    from levelproof.pipeline.learn.published import HANDMADE, handmade_folder

    add_levels(split, handmade_folder() if levels == HANDMADE else Path(levels), out)
