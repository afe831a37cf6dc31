"""Write a split's manifest and initial worlds to this folder, and its gallery's data to docs/example/.

The pages of docs/example/ are links to the gallery's own. See README.md here.

python manifests/make_reference.py data/128k/s
"""

import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.parquet as pq

from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.look.gallery.gallery import gallery
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.manifest import read_manifest

EXAMPLE = Path(__file__).parent.parent / "docs" / "example"


def main(split: Path) -> None:
    prepare_jax()
    name = f"{split.parent.name}-{split.name}"
    here = Path(__file__).parent
    table = read_manifest(split).table.sort_by("level_id")
    pq.write_table(table, here / f"{name}.parquet", compression="zstd")
    levels = arrays_of(sample_levels(table["level_id"].to_numpy(), SIZES[split.name]))
    np.savez_compressed(here / f"{name}-levels.npz", **levels)
    with TemporaryDirectory() as folder:
        gallery(split, Path(folder) / "gallery", None, len(table))
        shutil.rmtree(EXAMPLE / "data", ignore_errors=True)
        shutil.copytree(Path(folder) / "gallery" / "data", EXAMPLE / "data")
        shutil.copy(Path(folder) / "gallery" / "palette.css", EXAMPLE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
