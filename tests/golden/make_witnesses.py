"""Make witnesses.npz: the actions that solve the levels of a split, and hashes of the records of replaying them.

Run from the root of the repository after the reference manifest has been regenerated (see manifests/README.md):

    python -m tests.golden.make_witnesses data/128k/s
"""

import sys
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.manifest import read_manifest
from tests.experts.witness.bits import FILE, digests


def main(split: Path) -> None:
    prepare_jax()
    table = read_manifest(split).table
    solved = table.filter(pc.equal(table["label"], "solved")).sort_by("level_id")
    level_ids = solved["level_id"].to_numpy()
    action = read_rows(split, solved, ["record/action"])["record/action"].astype(np.int8)
    np.savez_compressed(FILE, level_id=level_ids, action=action, digest=digests(level_ids, action))
    print(f"{FILE}: witnesses of {len(level_ids)} levels")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
