"""The command `levelproof`. Jobs take Hydra overrides; other commands take the path of a split.

Imports nothing heavy before it knows the command, so that `levelproof --help` answers at once.
"""

import argparse
import errno
import re
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from levelproof.configs.errors import ConfigError, readable
from levelproof.pipeline.cli.command import EXITS
from levelproof.pipeline.errors import Exit, LevelproofError, UserError
from levelproof.pipeline.outlet import outlets
from levelproof.pipeline.urls import require_here, require_known, require_policy
from levelproof.pipeline.version import __version__

NAMES = (
    "generate regenerate settings sample inspect columns plan diff show gallery play clone train distill evaluate "
    "export grow import_ card status verify seal"
)
# Checks of arguments that are paths; those of other names must not be URLs of an unsupported kind
CHECKS = {"out": require_here, "plot": require_here, "policy": require_policy, "against": require_policy}
MOST_DIGITS = 20  # of a level id; int() refuses thousands
UNUSABLE = errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP  # errors of paths that the user named
LONG = 200  # characters of a path that are shown
COMMANDS = [import_module(f"levelproof.pipeline.cli.{name}") for name in NAMES.split()]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code, even if the reader of its output goes away."""
    with outlets():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    arguments, unknown = _parser().parse_known_args(argv)
    unknown = _taken(arguments, unknown)
    warnings.showwarning = lambda message, *_: print(f"Warning: {message}", file=sys.stderr)
    try:
        if unknown:
            raise UserError(_no_option(unknown, arguments))
        _check_paths(arguments)
        code = int(arguments.run(arguments) or Exit.DONE)
        sys.stdout.flush()  # now, so that a full disk is reported as an error
        return code
    except (LevelproofError, ConfigError) as error:
        if arguments.debug:
            raise
        return _report(str(error), getattr(error, "exit_code", Exit.INPUT))
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    except Exception as error:
        if arguments.debug:
            raise
        return _report(*_unforeseen(error))


def _unforeseen(error: Exception) -> tuple[str, int]:
    """Return the sentence and the exit code for an error that no code has turned into a LevelproofError."""
    if isinstance(error, OSError) and error.errno in UNUSABLE and isinstance(path := error.filename, str):
        shown = path if len(path) <= LONG else f"{path[:LONG]}..."
        return f"Cannot use {shown} ({error.strerror}): check the path and its permissions", Exit.INPUT
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else 'no message'} (--debug shows where)", Exit.FAILED


def _taken(arguments: argparse.Namespace, unknown: list[str]) -> list[str]:
    """Assign positional arguments that argparse leaves over because they follow an option; return the unknown ones."""
    if any(word.startswith("-") for word in unknown):
        return unknown
    for name, kind in {"words": str, "settings": str, "splits": Path}.items():
        if hasattr(arguments, name):
            setattr(arguments, name, [*getattr(arguments, name), *map(kind, unknown)])
            return []
    number = len(unknown) == 1 and unknown[0].isdecimal() and len(unknown[0]) < MOST_DIGITS
    if number and getattr(arguments, "level_id", 0) is None:
        arguments.level_id = int(unknown[0])
        return []
    return unknown


def _no_option(unknown: Sequence[str], arguments: argparse.Namespace) -> str:
    """Return the error for arguments that the command does not have; those behind an unknown option may be valid."""
    word = next((word for word in unknown if word.startswith("-")), unknown[0])
    if not word.startswith("-"):
        return f"There is no argument {word}: --help lists them."
    if word == "--debug":
        return "--debug comes after the command, as in levelproof generate --debug."
    if not {"settings", "words"} & vars(arguments).keys():
        return f"There is no option {word}: --help lists the options."
    example = "out=FOLDER" if word in ("-o", "--out") else re.findall(r"\S+=\S+", arguments.example)[0]
    return f"There is no option {word}: write settings as NAME=VALUE, as in {example}."


def _check_paths(arguments: argparse.Namespace) -> None:
    """Raise UserError for a path that is a URL of an unsupported kind, or that must be local."""
    for name, value in vars(arguments).items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path):
                CHECKS.get(name, require_known)(path)


def _report(sentence: str, code: int) -> int:
    """Print an error to stderr; return the exit code."""
    end = "" if sentence.endswith((".", ")")) else "."
    print(f"Error: {readable(sentence)}{end}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="levelproof",
        description="Make physics levels, search each for a solution, train an expert on it, keep what is verified.",
        epilog=f"Start with: levelproof generate\n{EXITS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"levelproof {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in COMMANDS:
        examples = "\n  ".join(["examples:", *command.EXAMPLE.splitlines()])
        added = commands.add_parser(
            command.__name__.rpartition(".")[2].rstrip("_"),  # `import` is a keyword
            help=command.SUMMARY,
            description=f"{command.SUMMARY[0].upper()}{command.SUMMARY[1:]}.",
            epilog=f"{examples}\n{EXITS}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(added)
        added.add_argument("--debug", action="store_true", help="show the traceback of an error")
        added.set_defaults(run=command.run, example=command.EXAMPLE)
    return parser
