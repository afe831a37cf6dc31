"""Add what experts do on the sealed levels to pipeline/learn/sealed.json, and hash them. See README.md here.

python manifests/make_sealed.py sealed
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np
from jaxtyping import UInt8

from levelproof.configs.numbers import parse_count
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import on_cpu, sample_levels
from levelproof.pipeline.learn import sealed
from levelproof.pipeline.learn.specialists import ATTEMPTS, successes_of
from levelproof.pipeline.store.manifest import require_manifest

COLUMNS = ["level_id", "label", "success_rate", "budget"]


def main(folder: Path) -> None:
    """Add every split of all sealed levels in a folder of splits; what is known of other budgets stays.

    The labels of a size are those of its largest budget.
    """
    path = Path(sealed.__file__).with_name(sealed.KNOWN)
    sizes = json.loads(path.read_text())["sizes"]
    for size in SIZES:
        known = sizes.get(size, {"labels": "", "successes": {}})
        for split in folder.glob(f"*/{size}"):
            table = require_manifest(split, COLUMNS).table.sort_by("level_id")
            if not np.array_equal(table["level_id"].to_numpy(), np.array(sealed.SEALED_IDS)):
                continue
            budget = table["budget"][0].as_py()
            known["successes"][budget] = "".join(sealed.SUCCESSES[each] for each in successes_of(table, ATTEMPTS))
            if max(known["successes"], key=steps_of) == budget:
                known["labels"] = "".join(sealed.LETTERS[label] for label in table["label"].to_pylist())
        if known["successes"]:
            sizes[size] = known | {"successes": dict(sorted(known["successes"].items(), key=lambda x: steps_of(x[0])))}
    path.write_text(json.dumps({"sizes": sizes}, indent=1) + "\n")
    np.save(path.with_name(sealed.HASHES), np.concatenate([digests_of(size) for size in SIZES]))


def digests_of(size: str) -> UInt8[np.ndarray, "level 16"]:
    """Return the content hashes of a size's sealed levels, without the version of their form."""
    with on_cpu():
        hashes = content_hashes(jax.device_get(sample_levels(np.array(sealed.SEALED_IDS, np.int32), size)))
    return np.array([[*bytes.fromhex(each.partition(":")[2])] for each in hashes], np.uint8)


def steps_of(budget: str) -> int:
    """Return the env steps of a budget."""
    return parse_count(budget, "budget")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
