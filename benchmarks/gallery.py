"""Speed of a gallery of many levels in a browser: time to the first levels, smoothness of scrolling, memory.

Headless Chromium without a GPU opens the site from disk. The split is synthetic: sampled levels, the first of which
were played at random, so that some reach the goal.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.browser import browser
from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.configs.numbers import parse_count
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label, Source, Verdict
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.witness.witness import replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import ACTIONS, size_of
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.look.gallery.gallery import gallery
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.layout import split_path

UNIT = 1000  # levels
HELD = 16  # env steps between action changes
SCROLLS = 5.0  # s
PACE = 40  # px a frame
MAX_SECONDS, MIN_FRAMES, MAX_GROWTH = 2.0, 50.0, 1.1  # the targets: s, frames/s, factor
JUMPS = 150
VIEW = {"width": 1280, "height": 900}
# Scroll for `length` ms; return the ms between frames
SCROLLING = """async ([length, pace]) => {
    const gaps = [];
    let before = await new Promise(requestAnimationFrame);
    const end = before + length;
    while (before < end) {
        scrollBy(0, pace);
        const now = await new Promise(requestAnimationFrame);
        gaps.push(now - before);
        before = now;
    }
    return gaps;
}"""
# Jump along the whole page, waiting at each stop until it is drawn
JUMPING = """async (jumps) => {
    for (let i = 0; i <= jumps; i++) {
        scrollTo(0, (document.body.scrollHeight - innerHeight) * i / jumps);
        for (let frame = 0; frame < 6; frame++) await new Promise(requestAnimationFrame);
    }
}"""
# Brush a histogram with a pointer, then sort; return the ms of the slowest brush move and of the sort
CHOOSING = """async () => {
    const svg = document.querySelector(".histogram svg");
    const { left, top, width } = svg.getBoundingClientRect();
    const at = (type, part) =>
        svg.dispatchEvent(new PointerEvent(type, { pointerId: 1, clientX: left + part * width, clientY: top }));
    svg.setPointerCapture = () => {};
    at("pointerdown", 0.1);
    const took = [];
    for (let part = 0.15; part < 0.9; part += 0.05) {
        const before = performance.now();
        at("pointermove", part);
        took.push(performance.now() - before);
    }
    at("pointerup", 0.9);
    document.getElementById("clear").click();
    const before = performance.now();
    const sort = document.getElementById("sort");
    sort.value = "env_steps";
    sort.dispatchEvent(new Event("change"));
    return [Math.max(...took), performance.now() - before];
}"""


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--levels", nargs="+", default=["10k", "100k"], help="levels of each gallery (default: 10k 100k)"
    )
    parser.add_argument("--size", default="s", help="size of the levels (default: s)")
    parser.add_argument("--folder", type=Path, help="keep the galleries in this folder, or reuse those in it")


def run(args: argparse.Namespace) -> Report:
    folder = args.folder or Path(tempfile.mkdtemp(prefix="levelproof-"))
    try:
        sites = {count: made_gallery(folder, args.size, parse_count(count, "levels")) for count in args.levels}
        with browser() as chromium:
            results = [{"levels": count, **measured(chromium, *site)} for count, site in sites.items()]
    finally:
        if not args.folder:
            shutil.rmtree(folder)
    slow = [result["levels"] for result in results if not fits(result)]
    return Report(
        title="Galleries of many levels",
        results=results,
        tables=[
            Table(("", *(f"{result['levels']} levels of {args.size}" for result in results)), [*rows(results)]),
        ],
        notes=[
            f"Headless Chromium without a GPU, {VIEW['width']} by {VIEW['height']} px, the site on disk. "
            "The first levels count as drawn when all cells of the first screen are. The page scrolls "
            f"{PACE} px a frame for {SCROLLS:.0f} s, over levels that must be loaded. Memory is JavaScript's after "
            "a garbage collection: with all columns, after jumps along the whole page, and after as many more. "
            f"The target is {MAX_SECONDS:.0f} s to the first levels, {MIN_FRAMES:.0f} frames/s, and memory growth "
            f"below {MAX_GROWTH - 1:.0%} in the second series of jumps.",
        ],
        fault=f"{', '.join(slow)} levels miss the target." if slow else "",
    )


def fits(result: Mapping[str, Any]) -> bool:
    return (
        result["first"] < MAX_SECONDS
        and result["frames"] > MIN_FRAMES
        and result["memory_again"] < MAX_GROWTH * result["memory_after"]
    )


def rows(results: list[dict[str, Any]]) -> list[list[str]]:
    lines = {
        "core-seconds to write": ("written", "{:.0f}"),
        "megabytes": ("megabytes", "{:.0f}"),
        "seconds to the first levels drawn": ("first", "{:.2f}"),
        "seconds to all columns": ("columns", "{:.2f}"),
        "frames/s while scrolling": ("frames", "{:.0f}"),
        "ms between frames, 99%": ("frame_99", "{:.0f}"),
        "ms to brush a histogram, the slowest": ("brush", "{:.0f}"),
        "ms to sort": ("sort", "{:.0f}"),
        "memory, MB": ("memory", "{:.1f}"),
        "memory after the whole page, MB": ("memory_after", "{:.1f}"),
        "memory after the whole page twice, MB": ("memory_again", "{:.1f}"),
    }
    return [[title, *(form.format(result[name]) for result in results)] for title, (name, form) in lines.items()]


def measured(chromium: Any, site: Path, written: float) -> dict[str, Any]:
    """Measure one gallery in a browser."""
    context = chromium.new_context(viewport=VIEW)
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    marks = [_mark(page, name) for name in ("levels are drawn", "all columns are there")]
    memory = _memory(context, page)
    gaps = np.array(page.evaluate(SCROLLING, [1000 * SCROLLS, PACE]))
    after = [_after_jumps(context, page) for _ in range(2)]
    brush, sort = page.evaluate(CHOOSING)
    context.close()
    return {
        "written": written,
        "megabytes": sum(path.stat().st_size for path in site.rglob("*") if path.is_file()) / 1e6,
        "first": marks[0],
        "columns": marks[1],
        "frames": 1000 * len(gaps) / gaps.sum(),
        "frame_99": float(np.quantile(gaps, 0.99)),
        "brush": brush,
        "sort": sort,
        "memory": memory,
        "memory_after": after[0],
        "memory_again": after[1],
    }


def _mark(page: Any, name: str) -> float:
    """Return the seconds from navigation to a mark that the page sets."""
    found = f"performance.getEntriesByName('{name}')"
    page.wait_for_function(f"{found}.length > 0")
    return page.evaluate(f"{found}[0].startTime") / 1000


def _after_jumps(context: Any, page: Any) -> float:
    """Return the memory after jumps along the whole page and back, MB."""
    page.evaluate(JUMPING, JUMPS)
    page.evaluate("scrollTo(0, 0)")
    page.wait_for_timeout(500)
    return _memory(context, page)


def _memory(context: Any, page: Any) -> float:
    """Return JavaScript's memory after a garbage collection, MB."""
    session = context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
    session.detach()
    return used


def made_gallery(folder: Path, size: str, levels: int) -> tuple[Path, float]:
    """Return a gallery of `levels` levels, written on first use, and the core-seconds that writing took."""
    site, took = folder / f"gallery-{size}-{levels}", folder / f"gallery-{size}-{levels}.txt"
    if not took.is_file():
        split = made_split(folder / str(levels), size, levels)
        start = time.process_time()
        gallery(split, site, None, levels)
        took.write_text(str(time.process_time() - start))
    return site, float(took.read_text())


def made_split(folder: Path, size: str, levels: int) -> Path:
    """Write a split whose first UNIT levels were played at random; those that reach the goal are solved.

    It replaces one whose writing was stopped.
    """
    prepare_jax()
    job, rng = compose_job([f"out={folder}", f"size={size}", f"levels={levels}"]), np.random.default_rng(0)
    split, count = split_path(job.out, job.budget, job.size), min(UNIT, levels)
    shutil.rmtree(split, ignore_errors=True)
    split.mkdir(parents=True)
    choices = rng.integers(0, 2, (RECORD_STEPS // HELD, ACTIONS, count))
    played = jax.tree.map(np.asarray, sample_levels(np.arange(count), size_of(size), job.distribution))
    record = replay(played, np.repeat(choices, HELD, axis=0), job.task)
    solved, steps = succeeds(record.done, record.goal), steps_to_goal(record.done)
    for first in range(0, levels, UNIT):
        ids = np.arange(first, min(first + UNIT, levels))
        level = jax.tree.map(np.asarray, sample_levels(ids, size_of(size), job.distribution))
        verdicts = [
            Verdict(
                Label.SOLVED, "random actions", False, Source.SEARCH, steps_to_goal=int(steps[i]), env_steps=int(spent)
            )
            if solved[i] and not first
            else Verdict(Label.UNSOLVED, "not played", False, success_rate=0.0, env_steps=int(spent))
            for i, spent in enumerate(rng.integers(0, 2**18, len(ids)))
        ]
        here = take(record, np.arange(len(ids)))  # commit stores only the records of levels with a witness
        commit(job, split, WorkUnit(tuple(ids.tolist())), UnitResult(ids, level, here, verdicts, EnvSteps()))
    return split
