"""The reference's 74 handmade levels, labelled one by one: the levels that everybody in the field knows.

They are read from its installation and have the ids that `generate level_files=` gives them: the same results. The
page has a picture of each solved one at the moment when its witness reaches the goal.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from benchmarks import oracle
from benchmarks.alone import label
from benchmarks.report import Report, Table
from configs.compose import compose_job
from configs.schema import JobConfig
from experts.labels import WITNESSED
from experts.train import UnitResult
from levelgen.pictures.raster import draw, sheet
from levelgen.pictures.words import Caption
from pipeline.errors import UserError
from pipeline.read.level_files import level_at, levels_below
from pipeline.runtime import own_cores, prepare_jax
from pipeline.store.origins import Origin

SIZES = ("s", "m", "l")
KINDS = {"scout": "scout_steps", "search": "search_steps", "training": "env_steps", "evaluation": "evaluation_steps"}
PLOT = "handmade.png"
COLUMNS, PIXELS = 8, 130  # of the sheet; width of a picture
HEAD = ("level", "size", "label", "seconds", *KINDS, "witness", "steps to goal")


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=SIZES, default=list(SIZES), help="default: all")
    parser.add_argument("--budget", default="256k", help="env steps an expert may use (default: 256k)")


def run(given: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    python = oracle.oracle_python()
    folder = oracle.handmade_levels(python)
    job = compose_job([f"level_files={folder}", f"budget={given.budget}"])
    listing = levels_below(folder, job)
    if listing.refused:
        raise UserError(listing.refused[0])
    results, solved = [], list[Image.Image]()
    for size in given.size:
        rows_of_size, pictures = labelled(job, listing.levels[size])
        results, solved = results + rows_of_size, solved + pictures
    rows = [[of["level"], of["size"], of["label"], *_cells(of)] for of in results]
    return Report(
        "The reference's handmade levels",
        results,
        [Table(HEAD, rows), Table(("size", "levels", "with a witness", "seconds", *KINDS), totals(results), "By size")],
        notes=[
            "Each level is labelled alone, on one core, by the default procedure; seconds are without compiling. The "
            "slots beside its expert are empty, so a job that labels many levels takes fewer seconds for each.",
            f"![The solved levels when their witnesses reach the goal]({PLOT})",
        ],
        plots={PLOT: lambda path: write_sheet(solved, path)} if solved else {},
        reference=oracle.versions(python),
    )


def labelled(job: JobConfig, origins: dict[int, Origin]) -> tuple[list[dict[str, Any]], list[Image.Image]]:
    """What came of each level, and how long it took; and pictures of the solved ones.

    What compiles for one does not count: it is done twice.
    """
    results, pictures, compiled = [], [], set()
    for level_id, origin in origins.items():
        result, seconds = timed(job, level_id, origin)
        verdict = result.verdicts[0]
        if new := {name for name in KINDS.values() if getattr(verdict, name)} - compiled:
            compiled |= new
            result, seconds = timed(job, level_id, origin)
            verdict = result.verdicts[0]
        of_level = {"level": Path(origin.file).stem, "size": origin.size, "label": str(verdict.label)}
        of_level |= {"seconds": seconds}
        of_level |= {kind: getattr(verdict, name) for kind, name in KINDS.items()}
        of_level |= {"witness": verdict.witness and str(verdict.witness), "steps to goal": verdict.steps_to_goal}
        results.append(of_level)
        if verdict.steps_to_goal is not None:
            pictures.append(picture_of(result, verdict.steps_to_goal - 1, Path(origin.file).stem))
        oracle.tell(f"{of_level['level']}: {of_level['label']}, {of_level['seconds']:.1f} s")
    return results, pictures


def picture_of(result: UnitResult, step: int, name: str) -> Image.Image:
    """The one level before this env step of its record."""
    state = jax.tree.map(lambda x: x[step], result.record.state)
    return draw(result.levels, state, caption=Caption(name), pixels=PIXELS)


def write_sheet(pictures: Sequence[Image.Image], path: Path) -> None:
    """In few colours: the file is a fraction of the size."""
    sheet(pictures, COLUMNS).quantize(64).save(path, optimize=True)


def timed(job: JobConfig, level_id: int, origin: Origin) -> tuple[UnitResult, float]:
    """What came of a level, and the seconds that it took."""
    level, ids = level_at(origin), np.array([level_id])
    start = time.perf_counter()
    result = label(level, ids, job.env_steps, job.procedure, job.task)
    return result, time.perf_counter() - start


def totals(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """A row for each size."""
    rows = []
    for size in dict.fromkeys(of["size"] for of in results):
        mine = [of for of in results if of["size"] == size]
        with_witness = sum(of["label"] in WITNESSED for of in mine)
        sums = [f"{sum(of[name] for of in mine):,}" for name in KINDS]
        rows.append([size, str(len(mine)), str(with_witness), f"{sum(of['seconds'] for of in mine):.1f}", *sums])
    return rows


def _cells(of: dict[str, Any]) -> list[str]:
    last = ["-" if of[name] is None else str(of[name]) for name in ("witness", "steps to goal")]
    return [f"{of['seconds']:.1f}", *(f"{of[name]:,}" for name in KINDS), *last]
