"""How much a longer search would find: the unsolved share against the env steps that a level is searched.

Every level that needs an expert is searched, until it has a success or its steps are used up. Levels
are searched one after another, so a run that is stopped goes on where it was: what is known of a level waits in the
cache folder.
"""

import argparse
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int
from scipy.stats import chi2

from benchmarks.oracle import tell
from benchmarks.report import Report, Table
from benchmarks.statistics import wilson
from configs.numbers import parse_count
from experts.before import decide
from experts.search.config import SearchConfig
from experts.search.search import Searched, Searching
from experts.witness import take
from levelgen.level import SIZES, Level
from levelgen.sampling.sampler import sample_levels
from levelgen.task.rules import DEFAULT_RULES
from pipeline.runtime import cache_folder, own_cores, prepare_jax

FIRST = 1_000_000  # level id: nothing was tuned on levels from there on
LEVELS = {"s": 256, "m": 128, "l": 64}
TOGETHER = 4  # levels that one program searches
LEAST = 16_384  # env steps at which the curve begins
COLOURS = {"s": "#0072b2", "m": "#d55e00", "l": "#009e73"}  # Okabe and Ito
PLOT = "search.svg"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, help="ids of each size (default: 256 of s, 128 of m, 64 of l)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"level id (default: {FIRST:,})")
    parser.add_argument("--env-steps", default="100M", help="of a search (default: 100M)")


def run(given: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    env_steps = parse_count(given.env_steps, "--env-steps")
    found = {size: searched(size, given.first, given.levels or LEVELS[size], env_steps) for size in given.size}
    budgets = doublings(env_steps)
    return Report(
        title="How much a longer search would find",
        results=[result(size, of, env_steps) for size, of in found.items()],
        tables=[
            Table(
                ("env steps a level", *(f"{size}, {len(of)} levels: unsolved" for size, of in found.items())),
                [[f"{n:,}", *(f"{unsolved(of, n).mean():.1%}" for of in found.values())] for n in budgets[::2]],
            ),
            Table(
                ("size", "unsolved at the end (95% interval)", "found in the last doubling", "in the next, at most"),
                [row(size, of, env_steps) for size, of in found.items()],
                "What more would find",
            ),
        ],
        notes=[
            f"Levels from id {given.first:,} on that are neither trivial nor proved unsolvable; the "
            "default search, no experts. *In the next, at most*: the 95% upper bound of what another doubling of the "
            "steps would find, taking that it finds no more than the last one did (each doubling has found less than "
            "the one before) and that finds are rare and independent (Poisson).",
            f"![Unsolved share against env steps of search]({PLOT})",
        ],
        plots={PLOT: lambda path: draw(path, found, budgets)},
    )


def searched(size: str, first: int, count: int, env_steps: int) -> Int[np.ndarray, " level"]:
    """Env steps to the success of each level that needs an expert; -1: none within `env_steps` of search."""
    ids = np.arange(first, first + count, dtype=np.int32)
    levels = jax.tree.map(np.asarray, sample_levels(ids, SIZES[size]))
    left = np.array([i for i, verdict in enumerate(decide(levels, DEFAULT_RULES).verdicts) if verdict is None])
    # the whole of it for every level; how short a success is does not matter here
    config = SearchConfig(env_steps=env_steps, bodies=0, per_cell=0, trials=1)
    settings = hashlib.sha256(repr(config).encode()).hexdigest()[:12]
    log = cache_folder() / f"search-{size}-{first}-{settings}.jsonl"
    known = read(log)
    for start in range(0, len(left), TOGETHER):
        if wanted := [i for i in left[start : start + TOGETHER] if int(ids[i]) not in known]:
            come = search(take(levels, np.array(wanted)), ids[wanted], config)
            new = {
                int(ids[i]): int(n) if length else -1
                for i, n, length in zip(wanted, come.env_steps, come.success.length, strict=True)
            }
            known |= new
            with log.open("a") as file:
                file.writelines(f"{json.dumps(pair)}\n" for pair in new.items())
        tell(f"{size}: {min(start + TOGETHER, len(left))} of {len(left)} levels are searched.")
    return np.array([known[int(ids[i])] for i in left])


def search(levels: Level, level_ids: Int[np.ndarray, " level"], config: SearchConfig) -> Searched:
    """Search every level until it has a success or has had its env steps."""
    searching = Searching(levels, level_ids, config, DEFAULT_RULES)
    while searching.step():
        pass
    return searching.result()


def read(log: Path) -> dict[int, int]:
    """What an earlier run found, by level id."""
    return dict(map(json.loads, log.read_text().splitlines())) if log.exists() else {}


def doublings(env_steps: int) -> list[int]:
    """From LEAST to the whole search, each twice the one before; the last one is the whole search."""
    budgets = [env_steps]
    while budgets[0] // 2 >= LEAST:
        budgets.insert(0, budgets[0] // 2)
    return budgets


def unsolved(steps: Int[np.ndarray, " level"], budget: int) -> np.ndarray:
    """Which levels have no success within this many env steps."""
    return (steps < 0) | (steps > budget)


def result(size: str, steps: Int[np.ndarray, " level"], env_steps: int) -> dict[str, Any]:
    """Of one size, as JSON has it."""
    last = int(unsolved(steps, env_steps // 2).sum() - (steps < 0).sum())
    return {
        "size": size,
        "levels": len(steps),
        "env_steps": env_steps,
        "unsolved": float((steps < 0).mean()),
        "interval": wilson(int((steps < 0).sum()), len(steps)),
        "last_doubling": last,
        "next_doubling_at_most": upper(last) / len(steps),
        "found_after": sorted(int(n) for n in steps if n >= 0),
    }


def upper(count: int) -> float:
    """One-sided 95% upper bound of a Poisson mean of which this count was seen (Garwood 1936)."""
    return float(chi2.ppf(0.95, 2 * (count + 1)) / 2)


def row(size: str, steps: Int[np.ndarray, " level"], env_steps: int) -> Sequence[str]:
    of = result(size, steps, env_steps)
    low, high = of["interval"]
    return (
        size,
        f"{of['unsolved']:.1%} ({low:.1%} to {high:.1%})",
        f"{of['last_doubling']} of {len(steps)} levels",
        f"{of['next_doubling_at_most']:.1%} of the levels",
    )


def draw(path: Path, found: dict[str, Int[np.ndarray, " level"]], budgets: list[int]) -> None:
    """The curves."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for size, steps in found.items():
        share = [100 * unsolved(steps, n).mean() for n in budgets]
        axes.plot(budgets, share, "o-", color=COLOURS[size], label=size, markersize=3)
    axes.set(xscale="log", ylim=(0, None), xlabel="env steps of search, a level", ylabel="unsolved, %")
    axes.legend(title="size", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    plt.close(figure)
