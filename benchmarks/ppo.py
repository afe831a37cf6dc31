"""Env steps/s of `levelproof train`, on one core and on all."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cloning import command, lines_of, slug
from benchmarks.report import Report, Table
from levelproof.configs.train import TrainConfig
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.runtime import own_cores

RATE, STEPS = "train/env_steps_per_second", "train/env_steps"
PLAIN = ("ppo.environments=512", "ppo.horizon=64", "ppo.epochs=2", "ppo.repeat=1", "ppo.subsample=1")  # as the pilot
SETTINGS = {"plain PPO": (PLAIN, 1), "the defaults": ((), 4)}  # and how many times --env-steps such a run takes


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=["s"], help="default: s")
    parser.add_argument("--env-steps", type=int, default=1_000_000, help="of a plain run (default: 1,000,000)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of all runs")
    parser.add_argument("--folder", type=Path, default=Path("ppo"), help="where runs are kept")


def run(args: argparse.Namespace) -> Report:
    network = TrainConfig().network
    every = sorted({1, len(own_cores())})
    results = [measured(args, size, cores, name) for size in args.sizes for name in SETTINGS for cores in every]
    rows = [
        [each["size"], each["settings"], str(each["cores"]), f"{each['rate']:,.0f}", f"{each['env_steps']:,}"]
        for each in results
    ]
    head = ("size", "settings", "cores", "env steps/s", "env steps")
    table = Table(head, rows, "Env steps/s of PPO over fresh random levels")
    words = " ".join((*PLAIN, *args.set))
    return Report(
        "Reinforcement learning: env steps/s",
        results,
        [table],
        [
            f"*Plain PPO*: `levelproof train {words}`. All with the default network unless a setting changes it "
            f"({network.depth} blocks of {network.kind}, width {network.width}). The rate is that of the clock, of "
            "all updates but the first; compiling and writing checkpoints do not count. One run each.",
        ],
    )


def measured(args: argparse.Namespace, size: str, cores: int, name: str) -> dict[str, Any]:
    """Train one policy with these settings, and return its rate."""
    policy, (settings, times) = args.folder / slug(f"{size}-{name}-{cores}"), SETTINGS[name]
    steps = f"ppo.env_steps={times * args.env_steps}"
    command("train", f"size={size}", f"cores={cores}", steps, *settings, *args.set, "-o", policy)
    last, about = lines_of(policy)[-1], {"size": size, "settings": name, "cores": cores}
    return about | {"rate": last.get(RATE, np.nan), "env_steps": int(last[STEPS])}
