"""The reference's handmade levels: what a policy solves that never saw them, trained on them, and from scratch.

A stopped run resumes: `levelproof train` resumes from its checkpoint, and the folder keeps finished evaluations.
"""

import argparse
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.cloning import GREEDY, SAMPLED, command, interval_text, kept, lines_of, slug
from benchmarks.equal import SECONDS, STEPS
from benchmarks.report import Report, Table
from levelproof.configs.numbers import parse_count
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.learn.evaluate import ALL
from levelproof.pipeline.learn.published import HANDMADE, HANDMADE_LEVELS, PROTOCOLS, handmade_folder
from levelproof.pipeline.runtime import own_cores

FEW = ("ppo.environments=512",)  # lanes: more updates in as many env steps
WAYS = {  # name: settings of `levelproof train`
    "tuned": (*FEW, "ppo.learning_rate=5e-4", "ppo.critic_updates=2"),
    "from scratch": (*FEW, "ppo.learning_rate=5e-4", "network.width=64"),
}
ATTEMPTS = PROTOCOLS[HANDMADE].attempts
PLAYERS = "random", "sticky random"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--start", default="builtin:s", help="policy to tune (default: builtin:s)")
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--seeds", type=int, default=1, help="policies of each way and size (default: 1)")
    parser.add_argument("--env-steps", default="4M", help="env steps of each policy (default: 4M)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of all training")
    parser.add_argument("--folder", type=Path, default=Path("tuned"), help="where policies are kept")


def run(args: argparse.Namespace) -> Report:
    args.folder.mkdir(parents=True, exist_ok=True)
    levels = handmade_folder()
    runs = [(size, way, seed) for size in args.sizes for way in WAYS for seed in range(args.seeds)]
    with ThreadPoolExecutor(len(own_cores())) as threads:
        trained = [*threads.map(lambda one: measured(args, levels, *one), runs)]
    untrained = [{"size": size, "way": "not trained on them", "last": None, "rates": zero_shot(args, size)}
                 for size in args.sizes]  # fmt: skip
    results = sorted((*untrained, *trained), key=lambda each: args.sizes.index(each["size"]))
    head = (
        "levels",
        "policy",
        "env steps on them",
        "core-seconds",
        "one attempt",
        "most probable",
        f"best of {ATTEMPTS}",
    )
    rows = [row for each in results for row in rows_of(each)]
    settings = "; ".join(f"*{way}*: `{' '.join((*words, *args.set))}`" for way, words in WAYS.items())
    return Report(
        "Handmade levels, with and without training on them",
        results,
        [Table(head, rows, "Share of the reference's handmade levels that are solved")],
        [
            f"*Not trained on them* is {args.start}; *tuned* starts from it. Training uses all levels of one size "
            f"({', '.join(f'{size}: {HANDMADE_LEVELS[size]}' for size in args.sizes)}), and policies play these, "
            f"{ATTEMPTS} attempts each; brackets: 95% intervals over levels. One row per seed.",
            f"`levelproof train` with {settings}. Core-seconds are CPU time with compiling, those of {args.start} "
            "not included.",
        ],
    )  # fmt: skip


def measured(args: argparse.Namespace, levels: Path, size: str, way: str, seed: int) -> dict[str, Any]:
    """Train one policy on the levels of a size, and measure it on them."""
    policy = args.folder / f"{slug(way)}-{size}-{seed}"
    steps = f"ppo.env_steps={parse_count(args.env_steps, '--env-steps')}"
    start = [f"start={args.start}"] if way == "tuned" else []
    job = f"levels={levels / size}", steps, f"seed={seed}", "cores=1", *start
    command("train", *job, *WAYS[way], *args.set, "-o", policy)
    rates = kept(policy / "handmade.json", policy, "--on", HANDMADE, "--size", size)
    return {"size": size, "way": way, "seed": seed, "last": lines_of(policy)[-1], "rates": rates}


def zero_shot(args: argparse.Namespace, size: str) -> dict[str, Any]:
    return kept(args.folder / f"{slug(args.start)}-{size}.json", args.start, "--on", HANDMADE, "--size", size)


def rows_of(each: Mapping[str, Any]) -> list[list[str]]:
    """Return the row of a policy, after those of random play if it was not trained on the levels."""
    last, rates, size = each["last"], each["rates"][ALL], each["size"]
    cost = (f"{last[STEPS]:,}", f"{last[SECONDS]:,.0f}") if last else ("0", "")
    ways = (SAMPLED, "once"), (GREEDY, "once"), (SAMPLED, "best")
    shown = lambda player, key: interval_text(rates[player][key])
    baselines = [[size, name, "", "", shown(name, "once"), "", shown(name, "best")] for name in PLAYERS]
    row = [size, each["way"], *cost, *(shown(*way) for way in ways)]
    return [row] if last else [*baselines, row]
