"""Write what experts do on the sealed levels to pipeline/learn/sealed.json. See README.md here.

python manifests/make_sealed.py sealed
"""

import json
import sys
from pathlib import Path

import numpy as np

from levelproof.configs.numbers import parse_count
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.learn import sealed
from levelproof.pipeline.learn.specialists import ATTEMPTS, successes_of
from levelproof.pipeline.store.manifest import require_manifest

COLUMNS = ["level_id", "label", "success_rate", "budget"]


def main(folder: Path) -> None:
    sizes = {}
    for size in SIZES:
        tables = [require_manifest(split, COLUMNS).table.sort_by("level_id") for split in folder.glob(f"*/{size}")]
        whole = [table for table in tables if np.array_equal(table["level_id"].to_numpy(), np.array(sealed.SEALED))]
        if not whole:
            continue
        whole.sort(key=lambda table: parse_count(table["budget"][0].as_py(), "budget"))
        text = lambda table: "".join(sealed.SUCCESSES[each] for each in successes_of(table, ATTEMPTS))
        labels = "".join(sealed.LETTERS[label] for label in whole[-1]["label"].to_pylist())
        sizes[size] = {"labels": labels, "successes": {table["budget"][0].as_py(): text(table) for table in whole}}
    Path(sealed.__file__).with_name(sealed.KNOWN).write_text(json.dumps({"sizes": sizes}, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
