"""The command `levelproof`. Jobs take Hydra overrides, questions take the path of a split.

Imports nothing heavy before it knows the command: `levelproof --help` has to answer at once.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from configs.convert import ConfigError
from pipeline.errors import Exit, LevelproofError

EXITS = "exit codes: 0 done, 1 failed, 2 something to change in the command, 3 done but for quarantined units"
SPLIT = "folder of a split, such as data/128k/s"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    arguments = _parser().parse_args(words)
    try:
        return int(arguments.run(arguments))
    except (LevelproofError, ConfigError) as error:
        if arguments.debug:
            raise
        return _refuse(str(error), getattr(error, "exit_code", Exit.INPUT))
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    except BrokenPipeError:  # `levelproof inspect ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.DONE
    except Exception as error:
        if arguments.debug:
            raise
        what = str(error).strip().splitlines()
        return _refuse(
            f"{type(error).__name__}: {what[0] if what else 'no message'} (--debug shows where)", Exit.FAILED
        )


def _refuse(sentence: str, code: int) -> int:
    end = "" if sentence.endswith((".", ")")) else "."
    print(f"Error: {sentence}{end}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="levelproof",
        description="Make physics levels, train an expert on each, and keep what provably solves them.",
        epilog=f"Start with: levelproof generate\n{EXITS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"levelproof {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(
        name: str, run: Callable[[argparse.Namespace], int], does: str, example: str, **options
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=does,
            description=f"{does[0].upper()}{does[1:]}.",
            epilog=f"example: {example}\n{EXITS}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            **options,
        )
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        sub.set_defaults(run=run)
        return sub

    sub = command(
        "generate",
        _generate,
        "make levels and their experts",
        "levelproof generate size=m levels=32 budget=64k out=data",
        add_help=False,
    )
    sub.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="settings to change; their defaults are below")
    sub.add_argument("-h", "--help", action="store_true", help="show this help and every setting")
    sub.set_defaults(parser=sub)

    sub = command(
        "regenerate",
        _regenerate,
        "train a manifest's levels at another budget",
        "levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\"",
    )
    sub.add_argument(
        "words",
        nargs="*",
        metavar="NAME=VALUE",
        help="manifest=SPLIT and budget=N; where=SQL: only its levels for which this condition on the manifest's "
        "columns holds; continue=true: experts that the split has kept (keep_experts=true) go on; "
        "and any setting of generate, such as out=NAME",
    )

    sub = command(
        "sample",
        _sample,
        "draw random levels, before anything is trained",
        "levelproof sample size=m distribution=clutter -o sheet.png",
    )
    sub.add_argument("settings", nargs="*", metavar="NAME=VALUE", help="as for generate, but levels=15 by default")
    sub.add_argument("-o", "--out", type=Path, default=Path("sheet.png"), help="file to write (default: sheet.png)")

    sub = command(
        "inspect",
        _inspect,
        "show what is in a split",
        "levelproof inspect data/128k/s --where \"label = 'solved' AND steps_to_goal < 64\"",
    )
    _split(sub)
    sub.add_argument(
        "--where", metavar="SQL", help="count only rows for which this condition on the manifest's columns holds"
    )
    sub.add_argument(
        "--against",
        type=Path,
        action="append",
        default=[],
        metavar="PATH",
        help="look for the same levels in another split, a level file, or a folder of them (may be repeated)",
    )
    sub.add_argument("--rows", type=int, default=10, help="rows, and pairs of duplicates, to show (default: 10)")
    _json(sub)

    sub = command(
        "show",
        _show,
        "draw a level's witness, or what doing nothing does",
        "levelproof show data/128k/s 7 -o level.gif",
    )
    sub.add_argument("source", type=Path, metavar="SPLIT", help=f"{SPLIT}; or a level file, such as level.json")
    sub.add_argument("level_id", type=int, nargs="?", metavar="LEVEL_ID", help="a level of the split")
    sub.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("level.gif"),
        help="file to write: .gif, .mp4, .svg or .png (default: level.gif)",
    )

    sub = command(
        "export", _export, "write a level as a file that Kinetix opens", "levelproof export data/128k/s 7 -o level.json"
    )
    _split(sub)
    sub.add_argument("level_id", type=int, metavar="LEVEL_ID", help="a level of the split")
    sub.add_argument("-o", "--out", type=Path, default=Path("level.json"), help="file to write (default: level.json)")

    sub = command("status", _status, "tell how far a split is", "levelproof status data/128k/s")
    _split(sub)
    _json(sub)

    sub = command(
        "verify", _verify, "read every shard of a split and replay every witness", "levelproof verify data/128k/s"
    )
    _split(sub)
    _json(sub)
    return parser


def _split(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, metavar="SPLIT", help=SPLIT)


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _version() -> str:
    try:
        return version("levelproof")
    except PackageNotFoundError:
        return "(not installed)"


def _generate(arguments: argparse.Namespace) -> int:
    from configs.compose import compose_job, listing

    if arguments.help:
        arguments.parser.print_help()
        print(f"\nevery setting and its default:\n{listing()}")
        return Exit.DONE
    job = compose_job(arguments.settings)

    from rich.console import Console

    from pipeline.jobs.generate import generate

    return generate(job, ["levelproof", "generate", *arguments.settings], Console(stderr=True))


def _regenerate(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from pipeline.jobs.regenerate import regenerate

    return regenerate(arguments.words, Console(stderr=True))


def _sample(arguments: argparse.Namespace) -> int:
    from configs.compose import compose_job
    from pipeline.look.sample import LEVELS, sample

    sample(compose_job([f"levels={LEVELS}", *arguments.settings]), arguments.out)
    return Exit.DONE


def _inspect(arguments: argparse.Namespace) -> int:
    from pipeline.look.inspect import inspect

    inspect(arguments.split, arguments.where, arguments.rows, arguments.json, arguments.against)
    return Exit.DONE


def _show(arguments: argparse.Namespace) -> int:
    from pipeline.look.show import show

    show(arguments.source, arguments.level_id, arguments.out)
    return Exit.DONE


def _export(arguments: argparse.Namespace) -> int:
    from pipeline.read.export import export

    export(arguments.split, arguments.level_id, arguments.out)
    return Exit.DONE


def _status(arguments: argparse.Namespace) -> int:
    from pipeline.look.status import status

    status(arguments.split, arguments.json)
    return Exit.DONE


def _verify(arguments: argparse.Namespace) -> int:
    from pipeline.read.verify import verify

    return verify(arguments.split, arguments.json)


if __name__ == "__main__":
    sys.exit(main())
