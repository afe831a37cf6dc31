"""Write the labels of splits to report.json, for the first tables of docs/results/solved.md.

then="search.bodies=7 search.patience=393216 search.patience_gap=0"  # the defaults until 2026-11-26
for settings in "$then out=before" out=after; do
  levelproof generate size=s levels=2000 first_level=1100000 budget=64k $settings
  levelproof generate size=m levels=1200 first_level=1100000 budget=256k $settings
  levelproof generate size=l levels=1120 first_level=1100000 budget=256k $settings
done
levelproof generate size=l levels=1120 first_level=1100000 budget=256k procedure=thorough out=thorough
python benchmarks/results/make_report.py before after thorough
"""

import json
import sys
from pathlib import Path
from typing import Any

from levelproof.configs.compose import changed_settings
from levelproof.pipeline.learn.sealed import LETTERS
from levelproof.pipeline.store.manifest import require_manifest

FIRST, LEVELS = 1_100_000, {"s": 2000, "m": 1200, "l": 1120}  # id of the first level; levels that count, by size
COLUMNS = ["level_id", "label", "budget", "size", "device"]


def described(split: Path) -> dict[str, Any]:
    """Return what the tables need of a split."""
    manifest = require_manifest(split, COLUMNS)
    rows = manifest.table.sort_by("level_id").to_pylist()
    rows = rows[: LEVELS[rows[0]["size"]]]
    assert [row["level_id"] for row in rows] == list(range(FIRST, FIRST + LEVELS[rows[0]["size"]]))
    settings = [setting for setting in changed_settings(manifest.config or {}) if not setting.startswith("size=")]
    return {
        "size": rows[0]["size"],
        "budget": rows[0]["budget"],
        "settings": " ".join(settings),
        "device": rows[0]["device"],
        "labels": "".join(LETTERS[row["label"]] for row in rows),
    }


if __name__ == "__main__":
    splits = [split for name in sys.argv[1:] for split in sorted(Path(name).glob("*/*"))]
    text = json.dumps({"first_level": FIRST, "splits": [described(split) for split in splits]}, indent=1)
    (Path(__file__).parent / "report.json").write_text(text + "\n")
