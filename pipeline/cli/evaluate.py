"""`levelproof evaluate`: measure how often a policy solves levels."""

import argparse
from pathlib import Path

from levelproof.pipeline.cli.command import add_json
from levelproof.pipeline.errors import UserError

SUMMARY = "measure how often a policy solves levels, compared with doing nothing and with random play"
EXAMPLE = """\
levelproof evaluate policy/
levelproof evaluate policy/ --on data/128k/s --where "label = 'solved'" --start 0 0.5
levelproof evaluate policy/ --on handmade
levelproof evaluate policy/ --against builtin:s --on data/128k/s
levelproof evaluate my_agent.py --attempts 4
levelproof evaluate policy/ --on data/128k/s --experts data/128k/s
levelproof evaluate --on my-levels --json"""
ON = (
    "split (folder or URL), level file or folder of them; `sealed`: 2,048 levels that are never trained on (default); "
    "`handmade` or `reference-random`: the levels on which the reference publishes solve rates"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    wrote = "folder of a policy that `levelproof clone`, `train` or `distill` wrote"
    policy = f"{wrote}, builtin:s or builtin:m, or a Python file that defines `act` (default: only the baselines play)"
    parser.add_argument("policy", type=Path, nargs="?", metavar="POLICY", help=policy)
    parser.add_argument("--on", default="sealed", metavar="LEVELS", help=ON)
    parser.add_argument("--where", metavar="SQL", help="use only levels of the split that meet this condition")
    size = "sizes of sealed levels (default: s) or of the reference's (default: s m l)"
    parser.add_argument("--size", nargs="+", help=size)
    parser.add_argument("--levels", type=int, metavar="COUNT", help="use only the first COUNT levels of each size")
    attempts = "attempts at each level (default: 8; on the reference's levels, as many as the reference makes)"
    parser.add_argument("--attempts", type=int, metavar="COUNT", help=attempts)
    parser.add_argument("--seed", type=int, default=0, help="seed of the attempts (default: 0)")
    start = "where in a split's witnesses attempts start, as shares of the steps to the goal; 0: the start (default)"
    parser.add_argument("--start", type=float, nargs="+", default=[0.0], metavar="SHARE", help=start)
    experts = "splits with the same levels, whose experts are listed for comparison"
    parser.add_argument("--experts", type=Path, nargs="+", default=[], metavar="SPLIT", help=experts)
    against = "another policy or Python file to compare with, level by level"
    parser.add_argument("--against", type=Path, metavar="POLICY", help=against)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    for name, least in ("levels", 1), ("attempts", 1), ("seed", 0):
        value = getattr(arguments, name)
        if value is not None and not least <= value < 2**31:
            raise UserError(f"--{name} is {value}: it must be from {least} to {2**31 - 1}.")
    if arguments.against and not arguments.policy:
        raise UserError("--against compares two policies: name the first one before it.")
    if arguments.experts and any(arguments.start):
        raise UserError("--experts rates episodes from the levels' start: leave out --start.")
    for share in arguments.start:
        if not 0 <= share < 1:
            raise UserError(f"--start is {share}: it must be at least 0 and below 1.")
    from levelproof.pipeline.learn.evaluate import evaluate, is_named
    from levelproof.pipeline.urls import require_known

    if is_named(arguments.on):
        if arguments.where is not None:
            raise UserError("--where selects levels of a split: name one with --on.")
    else:
        require_known(Path(arguments.on))
        if arguments.size is not None:
            raise UserError(f"--size selects sealed levels or the reference's: leave it out for {arguments.on}.")
    evaluate(
        arguments.policy,
        arguments.on,
        arguments.where,
        arguments.size,
        arguments.levels,
        arguments.attempts,
        arguments.seed,
        [*dict.fromkeys(arguments.start)],
        arguments.experts,
        arguments.json,
        arguments.against,
    )
