"""Hashes of the bits of the reference manifest's witnesses, replayed."""

import hashlib
import json
import sys

import jax
import numpy as np

from levelproof.experts.witness.witness import replay
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from tests.golden.load import HERE
from tests.processors import become

FILE = HERE / "witnesses.npz"


def digests(level_ids: np.ndarray, action: np.ndarray) -> list[str]:
    """Hash every bit of each level's record: states, contacts, points, rewards, flags."""
    record = jax.tree.leaves(replay(sample_levels(level_ids, SIZES["s"]), action))

    def digest(lane: int) -> str:
        total = hashlib.sha256()
        for leaf in record:
            total.update(np.ascontiguousarray(leaf[..., lane]).tobytes())
        return total.hexdigest()[:16]

    return [digest(lane) for lane in range(len(level_ids))]


if __name__ == "__main__":
    become(sys.argv[1])
    stored = np.load(FILE)
    print(json.dumps(digests(stored["level_id"], stored["action"])))
