"""The unsolved share against the env steps of search per level, and how much a longer search would find.

Every level that needs an expert is searched until it has a success or its env steps are spent: first all of them for a
few env steps, then those without a success for twice as many, and so on. The cache folder keeps the search of every
level, so a stopped run resumes, and a later run can extend the curve.
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
from benchmarks.plotting import pyplot, save
from benchmarks.report import Report, Table
from levelproof.configs.numbers import parse_count
from levelproof.experts.config import MAX_COUNTED
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.explore import Search, begin, explore
from levelproof.experts.search.play import success_of
from levelproof.experts.search.search import side_by_side
from levelproof.experts.verdict.before import decide
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.runtime import cache_folder, own_cores, prepare_jax

FIRST = 1_000_000  # first level id; the search was tuned on others
LEVELS = {"s": 256, "m": 128, "l": 64}
MIN_STEPS = 16_384  # env steps where the curve begins
CONFIG = SearchConfig(
    MAX_COUNTED // 2, bodies=0, patience=0, per_cell=0, rounds=64
)  # the default search, without an early end
COLOURS = {"s": "#0072b2", "m": "#d55e00", "l": "#009e73"}  # Okabe and Ito
PLOT = "search.svg"


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, help="levels of each size (default: 256 of s, 128 of m, 64 of l)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"first level id (default: {FIRST:,})")
    parser.add_argument(
        "--env-steps",
        nargs="+",
        default=["100M"],
        help="env steps of a search, one for all sizes or one each (default: 100M)",
    )


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    if len(args.env_steps) not in (1, len(args.size)):
        raise UserError("--env-steps: give one number for all sizes, or one for each.")
    budgets = np.broadcast_to([parse_count(x, "--env-steps") for x in args.env_steps], len(args.size)).tolist()
    max_steps = dict(zip(args.size, budgets, strict=True))
    folder = cache_folder() / "search"
    steps_by_size = {
        size: searched(size, args.first, args.levels or LEVELS[size], n, folder) for size, n in max_steps.items()
    }
    return Report(
        title="How much a longer search would find",
        results=[result(size, steps, max_steps[size]) for size, steps in steps_by_size.items()],
        tables=[curve(steps_by_size, max_steps), remainder(steps_by_size, max_steps)],
        notes=[
            f"Levels from id {args.first:,} on that are neither trivial nor proved unsolvable; the default search "
            "without an early end, no experts; every success is replayed. *In the next, at most*: the 95% upper bound "
            "on what another doubling of the steps would find, if finds are rare and independent (Poisson) and it "
            "finds no more than the last one.",
            f"![Unsolved share against env steps of search, with its 95% interval]({PLOT})",
        ],
        plots={PLOT: lambda path: draw(path, steps_by_size, max_steps)},
    )


def searched(size: str, first: int, count: int, env_steps: int, cache: Path) -> Int[np.ndarray, " level"]:
    """Search the levels that need an expert; return env steps to success, -1 if none within `env_steps`.

    Args:
        size: its name.
        first: first level id.
        count: number of ids.
        env_steps: limit for each level.
        cache: folder that keeps the levels' searches.
    """
    ids = np.arange(first, first + count, dtype=np.int32)
    levels = jax.tree.map(np.asarray, sample_levels(ids, SIZES[size]))
    undecided = np.array([i for i, verdict in enumerate(decide(levels, DEFAULT_RULES).verdicts) if verdict is None])
    levels, ids = take(levels, undecided), ids[undecided]
    settings = hashlib.sha256(repr((CONFIG, SAMPLER_VERSION, ENGINE_VERSION)).encode()).hexdigest()[:12]
    folder = cache / f"{size}-{settings}"
    rows = [read(folder, level_id) for level_id in ids]
    for max_steps in doublings(env_steps):
        unfinished = np.array([i for i, row in enumerate(rows) if row is None or under_way(row, max_steps)], int)
        for block in blocks(len(unfinished), side_by_side(CONFIG)):
            indices = unfinished[block]
            for i, row in zip(
                indices,
                advanced(take(levels, indices), ids[indices], [rows[i] for i in indices], max_steps),
                strict=True,
            ):
                rows[i] = row
                write(folder, int(ids[i]), row)
        log(f"{size}: {sum(int(row.length[0]) == 0 for row in rows if row)} levels unsolved within {max_steps:,}.")
    return steps_to_success(levels, [row for row in rows if row], env_steps)


def under_way(row: Search, env_steps: int) -> bool:
    """Whether a level has neither a success nor `env_steps` of search."""
    return int(row.length[0]) == 0 and int(row.env_steps[0]) < env_steps


def advanced(
    levels: Level, level_ids: Int[np.ndarray, " level"], rows: Sequence[Search | None], env_steps: int
) -> list[Search]:
    """Search levels side by side until each has a success or `env_steps`; return a row each.

    Args:
        levels: a full batch of the search.
        level_ids: their ids.
        rows: their searches so far; None: not yet begun.
        env_steps: limit for each level, counted from its beginning.
    """
    start = begin(levels, level_ids, CONFIG, DEFAULT_RULES)
    known = joined([row or fresh for row, fresh in zip(rows, split(start), strict=True)])
    search = replace(known, levels=start.levels, level_ids=start.level_ids)
    while np.asarray((search.length == 0) & (search.env_steps < env_steps)).any():
        search = explore(search, CONFIG, DEFAULT_RULES)
    return split(search)


def split(search: Search) -> list[Search]:
    """Split a search into a row per level, on the host, without constants and the archives of solved levels."""
    evolving = jax.device_get(replace(search, levels=None, level_ids=None))
    rows = [jax.tree.map(lambda x, i=i: x[i : i + 1], evolving) for i in range(len(evolving.length))]
    return [replace(row, archive=None) if row.length[0] else row for row in rows]


def joined(rows: Sequence[Search]) -> Search:
    """Concatenate rows."""
    return jax.tree.map(lambda *x: np.concatenate(x), *rows)


def steps_to_success(levels: Level, rows: Sequence[Search], env_steps: int) -> Int[np.ndarray, " level"]:
    """Return env steps of search to a success that replays; -1: none within `env_steps`."""
    both = joined([replace(row, archive=None) for row in rows])
    success = success_of(both.code, both.length)
    length, steps = np.asarray(success.length), np.array([int(row.env_steps[0]) for row in rows])
    goal = replay(levels, np.moveaxis(np.asarray(success.action), 0, -1)).goal
    reached = goal[length - 1, np.arange(len(length))] & (length > 0)
    return np.where(reached & (steps <= env_steps), steps, -1)


def read(folder: Path, level_id: int) -> Search | None:
    """Load a level's search from an earlier run; None if there is none."""
    path = folder / f"{level_id}.pickle"
    return pickle.loads(path.read_bytes()) if path.exists() else None


def write(folder: Path, level_id: int, row: Search) -> None:
    """Save a level's search for the next run."""
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / f"{level_id}.unfinished"
    unfinished.write_bytes(pickle.dumps(row))
    unfinished.replace(folder / f"{level_id}.pickle")


def doublings(env_steps: int) -> list[int]:
    """Return budgets, each about twice the one before, from MIN_STEPS or more to `env_steps`."""
    budgets = [env_steps]
    while budgets[0] // 2 >= MIN_STEPS:
        budgets.insert(0, budgets[0] // 2)
    return budgets


def unsolved(steps: Int[np.ndarray, " level"], budget: int) -> np.ndarray:
    """Return which levels have no success within `budget` env steps."""
    return (steps < 0) | (steps > budget)


def result(size: str, steps: Int[np.ndarray, " level"], env_steps: int) -> dict[str, Any]:
    """Summarise one size as a JSON document."""
    last = int(unsolved(steps, env_steps // 2).sum() - (steps < 0).sum())
    return {
        "size": size,
        "levels": len(steps),
        "env_steps": env_steps,
        "unsolved": float((steps < 0).mean()),
        "interval": Share(int((steps < 0).sum()), len(steps)).interval,
        "last_doubling": last,
        "next_doubling_at_most": upper(last) / len(steps),
        "found_after": sorted(int(n) for n in steps if n >= 0),
    }


def upper(count: int) -> float:
    """Return the one-sided 95% upper bound of a Poisson mean, given an observed count (Garwood 1936)."""
    return float(chi2.ppf(0.95, 2 * (count + 1)) / 2)


def curve(steps_by_size: Mapping[str, Int[np.ndarray, " level"]], max_steps: Mapping[str, int]) -> Table:
    """Tabulate the unsolved share of each size after each doubling, as far as it was searched."""
    head = "env steps a level", *(f"{size}, {len(steps)} levels: unsolved" for size, steps in steps_by_size.items())
    cell = lambda size, n: f"{unsolved(steps_by_size[size], n).mean():.1%}" if n in doublings(max_steps[size]) else "-"
    budgets = sorted({n for each in max_steps.values() for n in doublings(each)})
    return Table(head, [[f"{n:,}", *(cell(size, n) for size in steps_by_size)] for n in budgets])


def remainder(steps_by_size: Mapping[str, Int[np.ndarray, " level"]], max_steps: Mapping[str, int]) -> Table:
    """Tabulate what is unsolved at the end, and what another doubling would find at most."""
    head = "size", "env steps", "unsolved then (95% interval)", "found in the last doubling", "in the next, at most"
    return Table(
        head, [row(size, summary, max_steps[size]) for size, summary in steps_by_size.items()], "What more would find"
    )


def row(size: str, steps: Int[np.ndarray, " level"], env_steps: int) -> Sequence[str]:
    summary = result(size, steps, env_steps)
    return (
        size,
        f"{env_steps:,}",
        str(Share(int((steps < 0).sum()), len(steps))),
        f"{summary['last_doubling']} of {len(steps)} levels",
        f"{summary['next_doubling_at_most']:.1%} of the levels",
    )


def draw(path: Path, steps_by_size: Mapping[str, Int[np.ndarray, " level"]], max_steps: Mapping[str, int]) -> None:
    """Plot the curves with their intervals."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for size, steps in steps_by_size.items():
        budgets = doublings(max_steps[size])
        counts = [int(unsolved(steps, n).sum()) for n in budgets]
        low, high = 100 * np.array([Share(count, len(steps)).interval for count in counts]).T
        axes.plot(budgets, 100 * np.array(counts) / len(steps), "o-", color=COLOURS[size], label=size, markersize=3)
        axes.fill_between(budgets, low, high, color=COLOURS[size], alpha=0.15, linewidth=0)
    axes.set(xscale="log", ylim=(0, None), xlabel="env steps of search, a level", ylabel="unsolved, %")
    axes.legend(title="size", frameon=False)
    save(figure, path)
