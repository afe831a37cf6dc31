"""Policies trained by reinforcement learning, from scratch and from `builtin:s`: what they solve, and at what cost.

A stopped run resumes: `levelproof train` resumes from its checkpoint, and the folder keeps finished evaluations.
"""

import argparse
import re
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.cloning import SAMPLED, command, interval_text, kept, lines_of
from benchmarks.plotting import pyplot, save
from benchmarks.report import Report, Table
from levelproof.configs.numbers import parse_count
from levelproof.pipeline.learn.evaluate import ALL, SOLVED
from levelproof.pipeline.runtime import own_cores

START = "builtin:s"
OFTEN = "curriculum.every=25", "curriculum.measured_steps=512"  # settings for short runs
WAYS = {  # name: settings of `levelproof train`
    "from scratch": (),
    "from scratch, learnability": ("levels=learnability", *OFTEN),
    "from scratch, replay": ("levels=replay",),
    "from scratch, evolve": ("levels=evolve",),
    "from builtin:s": (f"start={START}",),
    "from builtin:s, learnability": (f"start={START}", "levels=learnability", *OFTEN),
    "from builtin:s, replay": (f"start={START}", "levels=replay"),
    "from builtin:s, evolve": (f"start={START}", "levels=evolve"),
}
PLOTTED = {"from scratch": "#0072b2", "from builtin:s": "#d55e00"}  # ways that draw levels evenly
ATTEMPTS = 8
PLOT = "learners.svg"
STEPS, SECONDS, RATE = "train/env_steps", "train/core_seconds", "train/solve_rate"


def register(parser: argparse.ArgumentParser) -> None:
    add_ways(parser, WAYS, "learners")
    parser.add_argument("--env-steps", default="10M", help="env steps of each policy (default: 10M)")


def add_ways(parser: argparse.ArgumentParser, ways: Collection[str], folder: str) -> None:
    """Add the arguments of a benchmark that trains policies in several ways."""
    parser.add_argument("--ways", nargs="+", choices=list(ways), default=list(ways), help="default: all")
    parser.add_argument("--size", default="s", help="size of the levels (default: s)")
    parser.add_argument("--seeds", type=int, default=1, help="policies of each way (default: 1)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of all training")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path(folder), help="where everything is kept")


def run(args: argparse.Namespace) -> Report:
    runs = [(way, seed) for seed in range(args.seeds) for way in args.ways]
    with ThreadPoolExecutor(len(own_cores())) as threads:
        results = [*threads.map(lambda one: measured(args, *one), runs)]
    begun = evaluated(args, args.folder / "start.json", START)
    rows = [row_of(START, None, begun)]
    rows += [row_of(each["way"], each, each["sealed"]) for each in results]
    players = "random", "sticky random", "its own expert, 256k"
    rows += [row_of(name, None, begun, name) for name in players if name in begun[ALL]]
    head = ("policy", "env steps", "core-seconds", "of all", "of solved", "of solved, best of 8")
    given = f", with {' '.join(f'`{setting}`' for setting in args.set)}" if args.set else ""
    return Report(
        "Policies trained by reinforcement learning",
        [*results, {"way": "start", "sealed": begun}],
        [Table(head, rows, "Share of sealed levels solved with sampled actions, one attempt; 95% intervals")],
        [
            f"`levelproof train size={args.size} cores=1` for {parse_count(args.env_steps, '--env-steps'):,} env steps "
            f"each{given}; one row per seed. Core-seconds are CPU time with compiling, without those of {START} and "
            f"its data. *Of all*: {begun[ALL]['random']['levels']:,} levels, of which some cannot be solved; *of "
            f"solved*: the {begun[SOLVED]['random']['levels']:,} that are labelled solved.",
            f"![Share of episodes that reach the goal in training, against core-seconds]({PLOT})",
            "The plot has the ways that train on fresh random levels: each episode is in a level never played before.",
        ],
        plots={PLOT: partial(draw, results)},
    )


def measured(args: argparse.Namespace, way: str, seed: int) -> dict[str, Any]:
    """Train one policy, and measure it on sealed levels."""
    policy = args.folder / f"{slug(way)}-{seed}"
    steps = f"ppo.env_steps={parse_count(args.env_steps, '--env-steps')}"
    command("train", f"size={args.size}", steps, f"seed={seed}", "cores=1", *WAYS[way], *args.set, "-o", policy)
    curve = [{name: line.get(name) for name in (STEPS, SECONDS, RATE)} for line in lines_of(policy)]
    rates = evaluated(args, policy / f"sealed-{curve[-1][STEPS]}.json", policy)
    return {"way": way, "seed": seed, "curve": curve, "sealed": rates}


def slug(name: str) -> str:
    """Return a name as the files and folders of a benchmark have it."""
    return re.sub("[ :,=]+", "-", name)


def evaluated(args: argparse.Namespace, file: Path, policy: Path | str) -> dict[str, Any]:
    """Return a policy's rates on sealed levels, from their file if an earlier run made it."""
    return kept(file, policy, "--size", args.size, "--attempts", ATTEMPTS, "--levels", args.measured)


def row_of(name: str, trained: dict[str, Any] | None, rates: dict[str, Any], player: str = SAMPLED) -> Sequence[str]:
    cost = ("", "")
    if trained:
        last = trained["curve"][-1]
        cost = (f"{last[STEPS]:,}", f"{last[SECONDS]:,.0f}")
    return [name, *cost, *rates_text(rates, player)]


def rates_text(rates: Mapping[str, Any], player: str) -> list[str]:
    """Return the rates of one attempt at all levels, of one at those labelled solved, and of the best at these."""
    ways = ((ALL, "once"), (SOLVED, "once"), (SOLVED, "best"))
    return [interval_text(rates[levels][player][key]) for levels, key in ways]


def draw(results: Sequence[dict[str, Any]], path: Path) -> None:
    """Plot the training solve rate of the ways in PLOTTED."""
    plt = pyplot()

    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for way, colour in PLOTTED.items():
        for each in (one for one in results if one["way"] == way):
            points = [(line[SECONDS], 100 * line[RATE]) for line in each["curve"][1:] if line[RATE] is not None]
            axes.plot(*zip(*points, strict=True), color=colour, label=way if each["seed"] == 0 else None, linewidth=1)
    axes.set(ylim=(0, None), xlabel="core-seconds", ylabel="episodes that reach the goal, %")
    axes.legend(frameon=False, loc="lower right")
    save(figure, path)
