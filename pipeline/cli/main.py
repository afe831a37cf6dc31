"""The command `levelproof`. Jobs take Hydra overrides, questions take the path of a split.

Imports nothing heavy before it knows the command: `levelproof --help` has to answer at once.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from levelproof.configs.errors import ConfigError, readable
from levelproof.pipeline.cli.command import EXITS
from levelproof.pipeline.errors import Exit, LevelproofError, UserError
from levelproof.pipeline.outlet import outlets
from levelproof.pipeline.urls import require_here, require_known
from levelproof.pipeline.version import __version__

NAMES = (
    "generate regenerate settings sample inspect columns plan diff show gallery play export import_ card status verify "
    "seal"
)
WRITTEN = ("out", "plot")  # what is written on this machine
COMMANDS = [import_module(f"levelproof.pipeline.cli.{name}") for name in NAMES.split()]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code, whoever reads what it prints."""
    with outlets():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments, unknown = _parser().parse_known_args(argv)
    warnings.showwarning = lambda message, *_: print(f"Warning: {message}", file=sys.stderr)
    try:
        if unknown:
            raise UserError(_no_option(unknown[0], takes_settings=bool({"settings", "words"} & vars(arguments).keys())))
        _look_at_paths(arguments)
        code = int(arguments.run(arguments) or Exit.DONE)
        if sys.stdout:
            sys.stdout.flush()  # here, where a full disk is an error
        return code
    except (LevelproofError, ConfigError) as error:
        if arguments.debug:
            raise
        return _refuse(str(error), getattr(error, "exit_code", Exit.INPUT))
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    except Exception as error:
        if arguments.debug:
            raise
        what = str(error).strip().splitlines()
        return _refuse(
            f"{type(error).__name__}: {what[0] if what else 'no message'} (--debug shows where)", Exit.FAILED
        )


def _no_option(word: str, takes_settings: bool) -> str:
    """A sentence for a word that the command does not take."""
    how = "write settings as NAME=VALUE, as in size=m" if takes_settings else "--help lists those that there are"
    return f"There is no option {word}: {how}."


def _look_at_paths(arguments: argparse.Namespace) -> None:
    """Raises UserError for one that stands for a URL of another kind than can be used there."""
    for name, value in vars(arguments).items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path):
                (require_here if name in WRITTEN else require_known)(path)


def _refuse(sentence: str, code: int) -> int:
    end = "" if sentence.endswith((".", ")")) else "."
    print(f"Error: {readable(sentence)}{end}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="levelproof",
        description="Make physics levels, train an expert on each, and keep what provably solves them.",
        epilog=f"Start with: levelproof generate\n{EXITS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"levelproof {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in COMMANDS:
        examples = "\n  ".join(["examples:", *command.EXAMPLE.splitlines()])
        added = commands.add_parser(
            command.__name__.rpartition(".")[2].rstrip("_"),  # `import` is a word of Python
            help=command.DOES,
            description=f"{command.DOES[0].upper()}{command.DOES[1:]}.",
            epilog=f"{examples}\n{EXITS}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(added)
        added.add_argument("--debug", action="store_true", help="show the traceback of an error")
        added.set_defaults(run=command.run)
    return parser
