"""The reference's 74 handmade levels, which the field knows, labelled one by one.

They are read from the reference's installation and have the ids that `generate level_files=` gives them, so results are
the same. The reference's PPO is measured beside them; the cache folder keeps its results. The page shows each solved
level at the moment when its witness reaches the goal.
"""

import argparse
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from benchmarks import oracle
from benchmarks.alone import label
from benchmarks.falls import fall
from benchmarks.report import Report, Table
from benchmarks.solved.variants import VARIANTS
from levelproof.configs.compose import compose_job
from levelproof.configs.numbers import parse_count
from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import WITNESSED, Verdict
from levelproof.experts.pool.run import UnitResult
from levelproof.levelgen.batching import blocks
from levelproof.levelgen.pictures.raster import draw, sheet
from levelproof.levelgen.pictures.words import Caption
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.level_files import level_at, levels_at, levels_below
from levelproof.pipeline.runtime import cache_folder, own_cores, prepare_jax
from levelproof.pipeline.store.origins import Origin

SIZES = ("s", "m", "l")
KINDS = {"search": "search_steps", "training": "env_steps", "evaluation": "evaluation_steps"}
PPO, PPO_BUDGET = VARIANTS["reference"].procedure, 1_000_000  # the reference's PPO, and its env steps
PPO_COLUMNS = {"PPO: first success": "steps_to_first_success", "PPO: steps to goal": "steps_to_goal"}
SIDE_BY_SIDE = 8  # levels on which the reference's PPO is trained together
PLOT = "handmade.png"
COLUMNS, PIXELS = 8, 130  # columns of the sheet; width of a picture
FALLS = (
    "level",
    "size",
    "weight of green, N",
    "lift of its thrusters at most, N",
    "env steps until red",
    "covers x, m",
)
HEAD = ("level", "size", "label", "seconds", *KINDS, "witness", "steps to goal", *PPO_COLUMNS)


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=SIZES, default=list(SIZES), help="default: all")
    parser.add_argument("--budget", default="256k", help="env steps an expert may use (default: 256k)")
    parser.add_argument(
        "--search",
        default="16M",
        help="search.env_steps; half of it is patience, a quarter variations (default: 16M, as there are few levels)",
    )


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    python = oracle.oracle_python()
    folder = oracle.handmade_levels(python)
    env_steps = parse_count(args.search, "--search")
    longer = {"env_steps": env_steps, "patience": env_steps // 2, "variations": env_steps // 4}
    settings = [f"search.{name}={steps}" for name, steps in longer.items()]
    job = compose_job([f"level_files={folder}", f"budget={args.budget}", *settings])
    listing = levels_below(folder, job)
    if listing.refused:
        raise UserError(listing.refused[0])
    results, solved = [], list[Image.Image]()
    for size in args.size:
        by_ppo = ppo(listing.levels[size], cache_folder() / "handmade")
        rows_of_size, pictures = labelled(job, listing.levels[size])
        results += [result | of_ppo for result, of_ppo in zip(rows_of_size, by_ppo, strict=True)]
        solved += pictures
    rows = [[result["level"], result["size"], result["label"], *_cells(result)] for result in results]
    sizes = ("size", "levels", "with a witness", "PPO at its end", "seconds", *KINDS)
    return Report(
        "The reference's handmade levels",
        results,
        [
            Table(HEAD, rows),
            Table(sizes, totals(results), "By size"),
            Table(FALLS, falls(job, listing.levels, args.size), "Levels in which green can only fall onto red"),
        ],
        notes=[
            "Each level is labelled alone, on one core, by the default procedure with "
            f"`{' '.join((f'budget={args.budget}', *settings))}`; seconds exclude compiling. "
            "The slots beside its expert are empty, so a job that labels many levels takes fewer seconds for each. The "
            "columns after the seconds are env steps.",
            f"*PPO*: the reference's hyperparameters for {PPO.expert.updates_in(PPO_BUDGET):,} updates of "
            f"{PPO.expert.steps_per_update:,} env steps, on our engine: the variant `reference` of "
            "[solved.md](solved.md), which also has it in the reference's own environment, where this would take some "
            "eight core-hours. It solves a level if its last evaluation has a witness; *first success*: env "
            "steps of training until then.",
            "In the levels of the last table no actions reach the goal: green is a circle that its thrusters cannot "
            "turn, they lift less than it weighs, and everything it can touch before it lands on the red floor is "
            "red (`benchmarks/falls.py`). In `h12_platformer_1` and `h13_platformer_2` the thrusters also "
            "lift half of green's weight, and before red green reaches only one side of a shelf, below its edge. In "
            "`hard_beam_balance`, `hard_cartpole_thrust` and `hard_cartpole_wheels` blue is more than a metre above "
            "what can reach it ([tried](../tried/labels.md)).",
            f"![The solved levels when their witnesses reach the goal]({PLOT})",
        ],
        plots={PLOT: lambda path: write_sheet(solved, path)} if solved else {},
        reference=oracle.versions(python),
    )


def labelled(job: JobConfig, origins: dict[int, Origin]) -> tuple[list[dict[str, Any]], list[Image.Image]]:
    """Label each level; return a row with its result and seconds, and pictures of the solved levels."""
    results, pictures = [], []
    for level_id, origin in origins.items():
        result, seconds = timed(job, level_id, origin)
        verdict = result.verdicts[0]
        of_level = {"level": Path(origin.file).stem, "size": origin.size, "label": str(verdict.label)}
        of_level |= {"seconds": seconds}
        of_level |= {kind: getattr(verdict, name) for kind, name in KINDS.items()}
        of_level |= {"witness": verdict.witness and str(verdict.witness), "steps to goal": verdict.steps_to_goal}
        results.append(of_level)
        if verdict.steps_to_goal is not None:
            pictures.append(picture_of(result, verdict.steps_to_goal - 1, Path(origin.file).stem))
        oracle.log(f"{of_level['level']}: {of_level['label']}, {of_level['seconds']:.1f} s")
    return results, pictures


def falls(job: JobConfig, levels: Mapping[str, Mapping[int, Origin]], sizes: Sequence[str]) -> list[list[str]]:
    """List each level whose green can only fall."""
    rows = []
    for origin in (origin for size in sizes for origin in levels[size].values()):
        if found_fall := fall(level_at(origin), job.task):
            numbers = f"{found_fall.weight:.2f}", f"{found_fall.lift:.2f}", str(found_fall.env_steps)
            left, right = found_fall.reach
            rows.append([Path(origin.file).stem, origin.size, *numbers, f"{left:.2f} to {right:.2f}"])
    return rows


def ppo(origins: Mapping[int, Origin], folder: Path) -> list[dict[str, Any]]:
    """Train the reference's PPO on each level; return PPO_COLUMNS. The folder keeps results for later runs."""
    settings = hashlib.sha256(repr((PPO, PPO_BUDGET, ENGINE_VERSION)).encode()).hexdigest()[:12]
    files = {level_id: folder / f"{level_id}-{settings}.json" for level_id in origins}
    known = {level_id: json.loads(file.read_text()) for level_id, file in files.items() if file.exists()}
    missing = np.array([level_id for level_id in origins if level_id not in known])
    folder.mkdir(parents=True, exist_ok=True)
    for block in blocks(len(missing), SIDE_BY_SIDE):
        ids = missing[np.unique(block)]
        result = label(levels_at([origins[i] for i in ids.tolist()]), ids, PPO_BUDGET, PPO)
        for level_id, verdict in zip(ids.tolist(), result.verdicts, strict=True):
            known[level_id] = ppo_results(verdict)
            files[level_id].write_text(json.dumps(known[level_id]))
        oracle.log(f"PPO: {len(known)} of {len(origins)} levels")
    return [known[level_id] for level_id in origins]


def ppo_results(verdict: Verdict) -> dict[str, int | None]:
    """Extract PPO_COLUMNS from a verdict."""
    return {name: getattr(verdict, field) for name, field in PPO_COLUMNS.items()}


def picture_of(result: UnitResult, step: int, name: str) -> Image.Image:
    """Draw the result's only level before this env step of its record."""
    state = jax.tree.map(lambda x: x[step], result.record.state)
    return draw(result.levels, state, caption=Caption(name), pixels=PIXELS)


def write_sheet(pictures: Sequence[Image.Image], path: Path) -> None:
    """Write a sheet in few colours, which shrinks the file."""
    sheet(pictures, COLUMNS).quantize(64).save(path, optimize=True)


def timed(job: JobConfig, level_id: int, origin: Origin) -> tuple[UnitResult, float]:
    """Label a level; return the result and the seconds it took, without compiling."""
    level, ids = level_at(origin), np.array([level_id])
    start = time.perf_counter()
    result = label(level, ids, job.env_steps, job.procedure, job.task)
    took = time.perf_counter() - start
    assert result.ledger
    return result, took - result.ledger.seconds_of(0).compiling


def totals(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Sum the results by size."""
    rows = []
    for size in dict.fromkeys(result["size"] for result in results):
        same_size = [result for result in results if result["size"] == size]
        witnessed = sum(result["label"] in WITNESSED for result in same_size)
        sums = [f"{sum(result[name] for result in same_size):,}" for name in KINDS]
        by_ppo = sum(result["PPO: steps to goal"] is not None for result in same_size)
        seconds = f"{sum(result['seconds'] for result in same_size):.1f}"
        rows.append([size, str(len(same_size)), str(witnessed), str(by_ppo), seconds, *sums])
    return rows


def _cells(result: dict[str, Any]) -> list[str]:
    last = ["-" if result[name] is None else _text(result[name]) for name in ("witness", "steps to goal", *PPO_COLUMNS)]
    return [f"{result['seconds']:.1f}", *(f"{result[name]:,}" for name in KINDS), *last]


def _text(value: str | int) -> str:
    return value if isinstance(value, str) else f"{value:,}"
