"""The job of `levelproof generate level_files=FOLDER`: a split for each size of the levels that are there."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
from rich.console import Console

from configs.schema import JobConfig
from pipeline.errors import Exit, UserError
from pipeline.jobs.generate import generate
from pipeline.jobs.progress import say
from pipeline.read.level_files import levels_below
from pipeline.runtime import prepare_jax


def generate_from_files(job: JobConfig, command: Sequence[str], console: Console) -> Exit:
    """Label the levels of `job.level_files`, size after size. Files that cannot be used are told and left out.

    Returns INPUT where one was left out, else what came of the splits.

    Raises:
        UserError: no file can be used, or as `generate`.
        Failure: as `generate`.
    """
    prepare_jax()
    if job.executor == "ray":
        jax.config.update("jax_platforms", "cpu")  # of this process only: GPUs are for workers
    folder = Path(job.level_files).expanduser()
    listing = levels_below(folder, job)
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
