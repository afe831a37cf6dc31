"""Env steps/s of both engines with the task's rules, without observations."""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks import oracle, race
from benchmarks.contest import Entry
from benchmarks.reference.actions import STICKINESS, sticky_actions
from benchmarks.report import Report


def register(parser: argparse.ArgumentParser) -> None:
    race.register(parser)
    parser.add_argument("--lanes", type=int, default=1024, help="worlds stepped side by side (default: 1024)")
    parser.add_argument("--steps", type=int, default=64, help="env steps of a run in each lane (default: 64)")
    parser.add_argument("--block", type=int, default=128, help="lanes per call of our engine (default: 128)")
    parser.add_argument(
        "--reference-block", type=int, help="lanes per call of the reference (default: all of a process)"
    )


def run(args: argparse.Namespace) -> Report:
    race.check(args, ("repeats", "lanes", "steps", "block", "reference_block"))
    python, their_block = oracle.oracle_python(), args.reference_block or args.lanes
    settings = {"lanes": args.lanes, "steps": args.steps, "block": args.block}
    settings |= {"reference_block": their_block, "stickiness": STICKINESS}
    with tempfile.TemporaryDirectory() as folder:
        actions = Path(folder) / "actions.npy"
        np.save(actions, sticky_actions(args.steps, args.lanes))

        def entries(size: str) -> list[Entry]:
            levels = args.level_file or oracle.sampled_levels(python, size)

            def arguments(share: race.Share) -> list[object]:
                return ["--levels", levels, "--actions", actions, "--first", share.first, "--lanes", share.count]

            return race.contestants(
                "physics",
                args.lanes,
                args.lanes * args.steps,
                lambda share: [*arguments(share), "--block", args.block],
                lambda share: [*arguments(share), "--block", their_block, "--size", size],
            )

        return race.run("Physics, beside the reference", args, entries, settings)
