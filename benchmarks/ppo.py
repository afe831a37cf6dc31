"""Env steps/s of `levelproof train`, on one core and on all."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cloning import command, lines_of
from benchmarks.report import Report, Table
from levelproof.configs.train import TrainConfig
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.runtime import own_cores

RATE, STEPS = "train/env_steps_per_second", "train/env_steps"
SETTINGS = ("ppo.environments=512", "ppo.horizon=64", "ppo.epochs=2", "ppo.repeat=1", "ppo.subsample=1")  # as the pilot


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=["s"], help="default: s")
    parser.add_argument("--env-steps", type=int, default=1_000_000, help="of each run (default: 1,000,000)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of all runs")
    parser.add_argument("--folder", type=Path, default=Path("ppo"), help="where runs are kept")


def run(args: argparse.Namespace) -> Report:
    network = TrainConfig().network
    every = sorted({1, len(own_cores())})
    results = [measured(args, size, cores) for size in args.sizes for cores in every]
    rows = [[each["size"], str(each["cores"]), f"{each['rate']:,.0f}", f"{each['env_steps']:,}"] for each in results]
    table = Table(("size", "cores", "env steps/s", "env steps"), rows, "Env steps/s of PPO over fresh random levels")
    words = " ".join((*SETTINGS, *args.set))
    return Report(
        "Reinforcement learning: env steps/s",
        results,
        [table],
        [
            f"`levelproof train {words}`, with the default network unless a setting changes it ({network.depth} blocks "
            f"of {network.kind}, width {network.width}). The rate is that of the clock, of all updates but the first; "
            "compiling and writing checkpoints do not count.",
        ],
    )


def measured(args: argparse.Namespace, size: str, cores: int) -> dict[str, Any]:
    """Train one policy, and return its rate."""
    policy = args.folder / f"{size}-{cores}"
    steps = f"ppo.env_steps={args.env_steps}"
    command("train", f"size={size}", f"cores={cores}", steps, *SETTINGS, *args.set, "-o", policy)
    last = lines_of(policy)[-1]
    return {"size": size, "cores": cores, "rate": last.get(RATE, np.nan), "env_steps": int(last[STEPS])}
