"""How much a longer search would find: the unsolved share against the env steps that a level is searched.

Every level that needs an expert is searched, until it has a success or its env steps are used up: first all of them a
little, then those without a success twice as long, and so on. What is known of a level waits in the cache folder, so a
run that is stopped goes on where it was; and a curve can be drawn as far as all levels of a size have come.
"""

import argparse
import hashlib
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int
from scipy.stats import chi2

from benchmarks.oracle import log
from benchmarks.report import Report, Table
from benchmarks.statistics import wilson
from levelproof.configs.numbers import parse_count
from levelproof.experts.config import MAX_COUNTED
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.explore import Search, begin, explore, success_of
from levelproof.experts.search.search import side_by_side
from levelproof.experts.verdict.before import decide
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.runtime import cache_folder, own_cores, prepare_jax

FIRST = 1_000_000  # level id: nothing was tuned on levels from there on
LEVELS = {"s": 256, "m": 128, "l": 64}
LEAST = 16_384  # env steps at which the curve begins
CONFIG = SearchConfig(MAX_COUNTED // 2, bodies=0, patience=0, per_cell=0, rounds=64)  # the default one, without an end
COLOURS = {"s": "#0072b2", "m": "#d55e00", "l": "#009e73"}  # Okabe and Ito
PLOT = "search.svg"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, help="ids of each size (default: 256 of s, 128 of m, 64 of l)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"level id (default: {FIRST:,})")
    parser.add_argument("--env-steps", nargs="+", default=["100M"], help="of a search, of each size (default: 100M)")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    wanted = np.broadcast_to([parse_count(x, "--env-steps") for x in args.env_steps], len(args.size)).tolist()
    most = dict(zip(args.size, wanted, strict=True))
    kept = cache_folder() / "search"
    found = {size: searched(size, args.first, args.levels or LEVELS[size], n, kept) for size, n in most.items()}
    return Report(
        title="How much a longer search would find",
        results=[result(size, of, most[size]) for size, of in found.items()],
        tables=[curve(found, most), more(found, most)],
        notes=[
            f"Levels from id {args.first:,} on that are neither trivial nor proved unsolvable; the default search "
            "without an early end, no experts; every success is replayed. *In the next, at most*: the 95% upper bound "
            "of what another doubling of the steps would find, if finds are rare and independent (Poisson) and it "
            "finds no more than the last one did.",
            f"![Unsolved share against env steps of search, with its 95% interval]({PLOT})",
        ],
        plots={PLOT: lambda path: draw(path, found, most)},
    )


def searched(size: str, first: int, count: int, env_steps: int, kept: Path) -> Int[np.ndarray, " level"]:
    """Env steps to the success of each level that needs an expert; -1: none within `env_steps` of search.

    Args:
        size: by its name.
        first: level id.
        count: how many ids.
        env_steps: of each level.
        kept: folder for what is known of levels.
    """
    ids = np.arange(first, first + count, dtype=np.int32)
    levels = jax.tree.map(np.asarray, sample_levels(ids, SIZES[size]))
    left = np.array([i for i, verdict in enumerate(decide(levels, DEFAULT_RULES).verdicts) if verdict is None])
    levels, ids = take(levels, left), ids[left]
    settings = hashlib.sha256(repr(CONFIG).encode()).hexdigest()[:12]
    folder = kept / f"{size}-{settings}"
    rows = [read(folder, level_id) for level_id in ids]
    for most in doublings(env_steps):
        going = np.array([i for i, row in enumerate(rows) if row is None or under_way(row, most)], int)
        for block in blocks(len(going), side_by_side(CONFIG)):
            at = going[block]
            for i, row in zip(at, advanced(take(levels, at), ids[at], [rows[i] for i in at], most), strict=True):
                rows[i] = row
                write(folder, int(ids[i]), row)
        log(f"{size}: {sum(int(row.length[0]) == 0 for row in rows if row)} levels unsolved within {most:,}.")
    return steps_to_success(levels, [row for row in rows if row], env_steps)


def under_way(row: Search, env_steps: int) -> bool:
    """Whether a level has no success yet, and has been searched for less."""
    return int(row.length[0]) == 0 and int(row.env_steps[0]) < env_steps


def advanced(
    levels: Level, level_ids: Int[np.ndarray, " level"], rows: Sequence[Search | None], env_steps: int
) -> list[Search]:
    """Levels searched on side by side, until each has a success or so many env steps; a row each, as before.

    Args:
        levels: as many as go side by side.
        level_ids: their ids.
        rows: what is known of each; None: nothing yet.
        env_steps: of each level, from its beginning.
    """
    start = begin(levels, level_ids, CONFIG, DEFAULT_RULES)
    known = joined([row or fresh for row, fresh in zip(rows, split(start), strict=True)])
    search = replace(known, levels=start.levels, key=start.key)
    while np.asarray((search.length == 0) & (search.env_steps < env_steps)).any():
        search = explore(search, CONFIG, DEFAULT_RULES)
    return split(search)


def split(search: Search) -> list[Search]:
    """A row for each level, on the host: what evolves, and of a level with a success no archive."""
    kept = jax.device_get(replace(search, levels=None, key=None))
    rows = [jax.tree.map(lambda x, i=i: x[i : i + 1], kept) for i in range(len(kept.length))]
    return [replace(row, archive=None) if row.length[0] else row for row in rows]


def joined(rows: Sequence[Search]) -> Search:
    """The levels of all rows."""
    return jax.tree.map(lambda *x: np.concatenate(x), *rows)


def steps_to_success(levels: Level, rows: Sequence[Search], env_steps: int) -> Int[np.ndarray, " level"]:
    """Env steps of search to a success that replays; -1: none within so many."""
    both = joined([replace(row, archive=None) for row in rows])
    found = success_of(both.code, both.length)
    length, steps = np.asarray(found.length), np.array([int(row.env_steps[0]) for row in rows])
    goal = replay(levels, np.moveaxis(np.asarray(found.action), 0, -1)).goal
    reached = goal[length - 1, np.arange(len(length))] & (length > 0)
    return np.where(reached & (steps <= env_steps), steps, -1)


def read(folder: Path, level_id: int) -> Search | None:
    """What an earlier run knew of a level."""
    path = folder / f"{level_id}.pickle"
    return pickle.loads(path.read_bytes()) if path.exists() else None


def write(folder: Path, level_id: int, row: Search) -> None:
    """Keep it for the next run."""
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / f"{level_id}.unfinished"
    unfinished.write_bytes(pickle.dumps(row))
    unfinished.replace(folder / f"{level_id}.pickle")


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


def curve(found: Mapping[str, Int[np.ndarray, " level"]], most: Mapping[str, int]) -> Table:
    """The unsolved share of each size after each doubling, as far as it was searched."""
    head = "env steps a level", *(f"{size}, {len(steps)} levels: unsolved" for size, steps in found.items())
    cell = lambda size, n: f"{unsolved(found[size], n).mean():.1%}" if n in doublings(most[size]) else "-"
    budgets = sorted({n for each in most.values() for n in doublings(each)})
    return Table(head, [[f"{n:,}", *(cell(size, n) for size in found)] for n in budgets])


def more(found: Mapping[str, Int[np.ndarray, " level"]], most: Mapping[str, int]) -> Table:
    """What is left at the end, and what would come."""
    head = "size", "env steps", "unsolved then (95% interval)", "found in the last doubling", "in the next, at most"
    return Table(head, [row(size, of, most[size]) for size, of in found.items()], "What more would find")


def row(size: str, steps: Int[np.ndarray, " level"], env_steps: int) -> Sequence[str]:
    of = result(size, steps, env_steps)
    low, high = of["interval"]
    return (
        size,
        f"{env_steps:,}",
        f"{of['unsolved']:.1%} ({low:.1%} to {high:.1%})",
        f"{of['last_doubling']} of {len(steps)} levels",
        f"{of['next_doubling_at_most']:.1%} of the levels",
    )


def draw(path: Path, found: Mapping[str, Int[np.ndarray, " level"]], most: Mapping[str, int]) -> None:
    """The curves and their intervals."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for size, steps in found.items():
        budgets = doublings(most[size])
        counts = [int(unsolved(steps, n).sum()) for n in budgets]
        low, high = 100 * np.array([wilson(count, len(steps)) for count in counts]).T
        axes.plot(budgets, 100 * np.array(counts) / len(steps), "o-", color=COLOURS[size], label=size, markersize=3)
        axes.fill_between(budgets, low, high, color=COLOURS[size], alpha=0.15, linewidth=0)
    axes.set(xscale="log", ylim=(0, None), xlabel="env steps of search, a level", ylabel="unsolved, %")
    axes.legend(title="size", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    plt.close(figure)
