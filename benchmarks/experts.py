"""Env steps/s of both programs when training one expert per level with the reference's hyperparameters."""

import argparse

from benchmarks import oracle, race
from benchmarks.contest import Entry
from benchmarks.reference.hyperparameters import PPO
from benchmarks.report import Report

COUNTS = ("levels", "environments", "horizon", "updates")


def register(parser: argparse.ArgumentParser) -> None:
    race.register(parser)
    parser.add_argument("--levels", type=int, default=32, help="levels, one expert each (default: 32)")
    for name, text in (("environments", "lanes of an expert"), ("horizon", "env steps in each lane between updates")):
        default = getattr(PPO, name)
        parser.add_argument(f"--{name}", type=int, default=default, help=f"{text} (default: {default})")
    parser.add_argument("--updates", type=int, default=4, help="updates of a run (default: 4)")


def run(args: argparse.Namespace) -> Report:
    race.check(args, ("repeats", *COUNTS))
    python, settings = oracle.oracle_python(), {name: getattr(args, name) for name in COUNTS}
    shape = [argument for name in COUNTS[1:] for argument in (f"--{name}", settings[name])]
    steps = args.levels * args.environments * args.horizon * args.updates

    def entries(size: str) -> list[Entry]:
        levels = args.level_file or oracle.sampled_levels(python, size)

        def arguments(share: race.Share) -> list[object]:
            return ["--levels", levels, *shape, "--first", share.first, "--count", share.count]

        return race.contestants(
            "experts", args.levels, steps, arguments, lambda share: [*arguments(share), "--size", size]
        )

    return race.run("Training, beside the reference", args, entries, settings)
