"""Levels that a short search misses and a long one solves: where they lie, and what their solutions look like.

The short search is that of `procedure=label`, the long one that of `procedure=thorough`; no experts are trained.
Threads search side by side, each its share of the levels.
"""

import argparse
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int
from PIL import Image

from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.experts.labels import Source
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.search.search import Searching, SearchResult
from levelproof.experts.verdict.before import decide
from levelproof.experts.verdict.judge import Witness, repeating
from levelproof.experts.verdict.portability import survival
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.pictures.raster import draw, sheet
from levelproof.levelgen.pictures.words import Caption
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.physics.types import FIXED_POLYGONS
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.runtime import own_cores, prepare_jax

REPLAYS = 128  # of each solution, from starts perturbed by a rounding error
PLOT = "late.png"
COLUMNS, PIXELS = 4, 200  # columns of the sheet, two for each level; width of a picture
HEAD = ("level", "bodies", "joints", "motors", "thrusters", "env steps of the search", "found by", "steps to goal",
        "changes of the action", "of its replays reach the goal")  # fmt: skip


class Found(NamedTuple):
    """Undecided levels, and what the searches found; level axis first, except in `levels`."""

    levels: Level
    level_ids: Int[np.ndarray, " level"]
    early: Bool[np.ndarray, " level"]  # solved by the short search
    late: Bool[np.ndarray, " level"]  # solved by the long one alone
    results: SearchResult  # of the long search, for the levels left by the short one, in order


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", default="l", help="size of the levels (default: l)")
    parser.add_argument("--levels", type=int, default=512, help="number of levels (default: 512)")
    parser.add_argument("--first-level", type=int, default=300_000, help="id of the first (default: 300000)")
    parser.add_argument("--pictures", type=int, default=20, help="number of levels to show (default: 20)")


def run(args: argparse.Namespace) -> Report:
    threads = len(own_cores())
    prepare_jax(threads=threads)
    found = searched(args.size, np.arange(args.first_level, args.first_level + args.levels, dtype=np.int32), threads)
    shown = np.flatnonzero(found.late)[: args.pictures]
    rows, pictures = solutions(found, shown)
    cells = [[f"{x:,}" if isinstance(x, int) else str(x) for x in row.values()] for row in rows]
    return Report(
        "Levels that only a long search solves",
        rows,
        [
            Table(
                ("levels", "undecided", "solved by the short search", "by the long one alone", "of those left"),
                groups(found),
            ),
            Table(HEAD, cells, f"The first {len(rows)} of them by id"),
        ],
        notes=[
            "Short: the search of `procedure=label`; long: that of `procedure=thorough`. No experts are trained.",
            "Bodies and joints are those of a level besides the room's. *Found by*: Go-Explore, or variations of the "
            "trajectories that came nearest. The solution is shortened before its env steps and the changes of its "
            f"action are counted. The last column: of {REPLAYS} replays from starts perturbed by a rounding error.",
            f"![Each level at its start and when its solution reaches the goal]({PLOT})",
        ],
        plots={PLOT: lambda path: write_sheet(pictures, path)} if pictures else {},
    )


def searched(size: str, level_ids: Int[np.ndarray, " level"], threads: int) -> Found:
    """Search the undecided levels among these ids, briefly first, then those left for long."""
    levels: Level = jax.tree.map(np.asarray, sample_levels(level_ids, size_of(size)))
    undecided = np.array([i for i, known in enumerate(decide(levels, DEFAULT_RULES).verdicts) if known is None], int)
    levels, level_ids = take(levels, undecided), level_ids[undecided]
    early = np.asarray(search(levels, level_ids, search_of("label"), threads).success.length) > 0
    left = np.flatnonzero(~early)
    results = search(take(levels, left), level_ids[left], search_of("thorough"), threads)
    late = np.zeros(len(level_ids), bool)
    late[left] = results.success.length > 0
    return Found(levels, level_ids, early, late, results)


def search_of(procedure: str) -> SearchConfig:
    return compose_job([f"procedure={procedure}"]).search


def search(levels: Level, level_ids: Int[np.ndarray, " level"], config: SearchConfig, threads: int) -> SearchResult:
    """Search levels to their end, in threads; every thread has the same share of them."""

    def share(number: int) -> SearchResult:
        searching = Searching(config, DEFAULT_RULES)
        job = searching.submit(take(levels, np.arange(number, len(level_ids), threads)), level_ids[number::threads])
        while searching.step():
            pass
        return searching.result(job)

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(share, range(threads)))
    order = np.argsort(np.concatenate([np.arange(number, len(level_ids), threads) for number in range(threads)]))
    return jax.tree.map(lambda *xs: np.concatenate(xs)[order], *parts)


def groups(found: Found) -> list[list[str]]:
    """Return how many levels of each kind the searches solve, with 95% intervals."""
    model = found.levels.model
    thrusters, joints = np.asarray(model.thruster_active).sum(0), np.asarray(model.joint_active).sum(0)
    bodies = bodies_of(found.levels)
    middle = int(np.median(bodies)), int(np.median(joints))
    kinds: Mapping[str, Bool[np.ndarray, " level"]] = {
        "all": np.ones(len(bodies), bool),
        **{counted(number, "thruster"): thrusters == number for number in range(int(thrusters.max(initial=0)) + 1)},
        f"at most {counted(middle[0], 'body')}": bodies <= middle[0],
        f"more than {counted(middle[0], 'body')}": bodies > middle[0],
        f"at most {counted(middle[1], 'joint')}": joints <= middle[1],
        f"more than {counted(middle[1], 'joint')}": joints > middle[1],
    }
    share = lambda some, of: (
        f"{some} ({some / max(of, 1):.0%}, {' to '.join(f'{x:.0%}' for x in Share(some, of).interval)})"
    )
    rows = []
    for name, these in kinds.items():
        count, early, late = (int((these & mask).sum()) for mask in (these, found.early, found.late))
        rows.append([name, str(count), share(early, count), str(late), share(late, count - early)])
    return rows


def counted(number: int, thing: str) -> str:
    return f"{number} {thing if number == 1 else 'bodies' if thing == 'body' else thing + 's'}"


def bodies_of(levels: Level) -> Int[np.ndarray, " level"]:
    """Count the bodies besides the room's."""
    return np.asarray(levels.model.active)[FIXED_POLYGONS:].sum(0)


def solutions(found: Found, shown: Int[np.ndarray, " index"]) -> tuple[list[dict[str, Any]], list[Image.Image]]:
    """Describe the solutions of these levels; return their rows, and two pictures of each."""
    if not len(shown):
        return [], []
    at = np.searchsorted(np.flatnonzero(~found.early), shown)
    some, ids = take(found.levels, shown), found.level_ids[shown]
    success, env_steps, varied = (jax.tree.map(lambda x: np.asarray(x)[at], x) for x in found.results[:3])
    witnesses: list[Witness] = [repeating(Success(*one), Source.SEARCH)[0] for one in zip(*success, strict=True)]
    survived = survival(some, ids, witnesses, REPLAYS, DEFAULT_RULES)
    record = replay(some, np.stack([witness.action for witness in witnesses], -1))
    rows, pictures, model = [], list[Image.Image](), some.model
    for i, (level_id, witness) in enumerate(zip(ids.tolist(), witnesses, strict=True)):
        played = witness.action[: witness.steps]
        numbers = [
            model.joint_active[:, i],
            model.motor_on[:, i] & model.joint_active[:, i],
            model.thruster_active[:, i],
        ]
        described = (
            level_id,
            int(bodies_of(some)[i]),
            *(int(np.asarray(x).sum()) for x in numbers),
            int(env_steps[i] + varied[i]),
            "variations" if varied[i] else "Go-Explore",
            witness.steps,
            int((played[1:] != played[:-1]).any(-1).sum()),
            f"{survived[i]:.0%}",
        )
        rows.append(dict(zip(HEAD, described, strict=True)))
        pictures += [
            picture(take(some, np.array([i])), record, i, step, f"{level_id}: {step}")
            for step in (0, witness.steps - 1)
        ]
    return rows, pictures


def picture(level: Level, record: Any, index: int, step: int, name: str) -> Image.Image:
    """Draw a level before this env step of its record."""
    state = jax.tree.map(lambda x: x[step, ..., index : index + 1], record.state)
    return draw(level, state, caption=Caption(name), pixels=PIXELS)


def write_sheet(pictures: list[Image.Image], path: Path) -> None:
    """Write a sheet with a palette, which shrinks the file."""
    sheet(pictures, COLUMNS).quantize(256).save(path, optimize=True)
