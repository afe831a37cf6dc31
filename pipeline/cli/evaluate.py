"""`levelproof evaluate`: measure how often a policy solves levels."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_json
from levelproof.pipeline.errors import UserError

SUMMARY = "measure how often a policy solves levels, beside doing nothing and random play"
EXAMPLE = """\
levelproof evaluate policy/
levelproof evaluate policy/ --on data/128k/s --where "label = 'solved'" --attempts 8
levelproof evaluate --on my-levels --json"""
SEALED = "sealed"
ON = (
    "split (folder or URL), level file or folder of them, or `sealed`: 2,048 levels that are never trained on (default)"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    policy = "folder of a policy that `levelproof clone` wrote (default: only the baselines play)"
    parser.add_argument("policy", type=Path, nargs="?", metavar="POLICY", help=policy)
    parser.add_argument("--on", default=SEALED, metavar="LEVELS", help=ON)
    parser.add_argument("--where", metavar="SQL", help="use only levels of the split that meet this condition")
    parser.add_argument("--size", nargs="+", default=["s"], help="sizes of the sealed levels (default: s)")
    parser.add_argument("--levels", type=int, metavar="COUNT", help="use only the first levels of each size")
    parser.add_argument("--attempts", type=int, default=8, metavar="COUNT", help="attempts at each level (default: 8)")
    parser.add_argument("--seed", type=int, default=0, help="of the attempts (default: 0)")
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    for name, least in ("levels", 1), ("attempts", 1), ("seed", 0):
        value = getattr(arguments, name)
        if value is not None and not least <= value < 2**31:
            raise UserError(f"--{name} is {value}: it must be from {least} to {2**31 - 1}.")
    from levelproof.pipeline.learn.evaluate import evaluate
    from levelproof.pipeline.urls import require_known

    place = None if arguments.on == SEALED else Path(arguments.on)
    if place is None and arguments.where is not None:
        raise UserError("--where selects levels of a split: name one with --on.")
    if place is not None:
        require_known(place)
    evaluate(
        arguments.policy,
        place,
        arguments.where,
        arguments.size,
        arguments.levels,
        arguments.attempts,
        arguments.seed,
        arguments.json,
    )
