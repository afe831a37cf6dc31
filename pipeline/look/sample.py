"""Sheet of sampled levels, to show a size and a distribution before anything is trained."""

from pathlib import Path

import jax
import numpy as np
from PIL import Image

from levelproof.configs.compose import name_and_hash
from levelproof.configs.schema import JobConfig
from levelproof.levelgen.level import size_of
from levelproof.levelgen.pictures.raster import Caption, draw, sheet, write_png
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.files import replacing

LEVELS = 15  # default number of levels
MAX_LEVELS = 100
COLUMNS = 5
PIXELS = 220  # width of a level's picture


def sample(job: JobConfig, out: Path) -> None:
    """Draw the initial worlds of the job's levels to `out`; print one line about the sheet.

    Raises:
        UserError: too many levels, or the file cannot be written.
    """
    ids = job.level_ids
    if out.suffix.lower() != ".png":
        raise UserError(f"Cannot draw to {out}: its name must end in .png.")
    if len(ids) > MAX_LEVELS:
        raise UserError(f"levels is {job.levels}: a sheet has room for at most {MAX_LEVELS}.")
    prepare_jax()
    page = sheet_of(job)
    with writing_to(out), replacing(out) as unfinished:
        write_png(page, unfinished)
    name, _ = name_and_hash(job.distribution)
    print(f"{out}: levels {ids[0]} to {ids[-1]} of size {job.size}, distribution {name or 'custom'}")


def sheet_of(job: JobConfig) -> Image.Image:
    """Draw the initial worlds of the job's levels, row by row."""
    levels = jax.tree.map(np.asarray, sample_levels(job.level_ids, size_of(job.size), job.distribution))
    captions = [Caption(f"level {level_id}") for level_id in job.level_ids]
    pictures = [
        draw(levels, levels.state, lane, caption=caption, pixels=PIXELS) for lane, caption in enumerate(captions)
    ]
    return sheet(pictures, COLUMNS)
