"""The job of `levelproof generate level_files=FOLDER`: one split for each size among the level files."""

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
    """Label the levels of `job.level_files`, one size after another; report and leave out unusable files.

    Returns INPUT if a file was left out, else the largest exit code of the splits.

    Raises:
        UserError: no file can be used; or see `generate`.
        Failure: see `generate`.
    """
    folder = Path(job.level_files).expanduser()
    if job.executor == "inline":
        prepare_jax(device=job.device)
        listing = levels_below(folder, job)
    else:
        listing = _list_in_subprocess(folder, job)
    for sentence in (*listing.copies, *listing.refused):
        say(console, sentence)
    if not listing.levels:
        raise UserError(f"None of the level files in {folder} can be used, for the reasons above: fix one of them.")
    exits = [
        generate(replace(job, size=size), command, console, origins=origins) for size, origins in listing.levels.items()
    ]
    if listing.refused:
        say(console, f"{len(listing.refused)} of the level files in {folder} were left out, for the reasons above.")
        return Exit.INPUT
    return max(exits)


def _list_in_subprocess(folder: Path, job: JobConfig) -> Listing:
    """Call `levels_below` in another process: Ray forks this one, which must not have started JAX before."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), prepare_jax, (None, "cpu")) as process:
        return process.submit(levels_below, folder, job).result()
