"""The job of `levelproof generate level_files=FOLDER`: a split for each size of the levels that are there."""

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.errors import Exit, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.read.level_files import Listing, levels_below
from levelproof.pipeline.runtime import prepare_jax


def generate_from_files(job: JobConfig, command: Sequence[str], console: Console) -> Exit:
    """Label the levels of `job.level_files`, size after size. Files that cannot be used are told and left out.

    Returns INPUT where one was left out, else what came of the splits.

    Raises:
        UserError: no file can be used, or as `generate`.
        Failure: as `generate`.
    """
    folder = Path(job.level_files).expanduser()
    if job.executor == "inline":
        prepare_jax(device=job.device)
        listing = levels_below(folder, job)
    else:
        listing = _listed_elsewhere(folder, job)
    for sentence in (*listing.copies, *listing.refused):
        say(console, sentence)
    if not listing.levels:
        raise UserError(f"None of the level files in {folder} can be used, for the reasons above: mend one of them.")
    ends = [
        generate(replace(job, size=size), command, console, origins=origins) for size, origins in listing.levels.items()
    ]
    if listing.refused:
        say(console, f"{len(listing.refused)} of the level files in {folder} were left out, for the reasons above.")
        return Exit.INPUT
    return max(ends)


def _listed_elsewhere(folder: Path, job: JobConfig) -> Listing:
    """`levels_below`, read by a process of its own: Ray forks this one, which must not have started JAX by then."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), prepare_jax, (None, "cpu")) as process:
        return process.submit(levels_below, folder, job).result()
