"""How far a split is: what the last command wanted, what is committed, what was given up, whether a run is at work."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.store.layout import JOB, QUARANTINE
from pipeline.store.locks import is_written
from pipeline.store.manifest import read_manifest


def status(split: Path, as_json: bool) -> None:
    """Print how far `split` is.

    Raises:
        UserError: there is no split.
        Failure: a fragment is damaged.
    """
    facts = look(split)
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    counts = "".join(f", {count} {label}" for label, count in facts["labels"].items())
    print(f"{split}: {facts['done']} of {facts['wanted']} levels committed{counts}.")
    for note in facts["quarantined"]:
        print(f"Given up: {split / QUARANTINE / note}")
    if facts["running"]:
        print("A run is at work now.")
    elif facts["done"] < facts["wanted"]:
        print(f"No run is at work. To go on: {facts['command']}")


def look(split: Path) -> dict[str, Any]:
    """The facts that `status` prints."""
    try:
        job = json.loads((split / JOB).read_text())
        wanted = np.array(sorted(job["level_ids"]), np.int64).reshape(-1, 2)  # first and last of each run of ids
    except FileNotFoundError:
        raise UserError(
            f"There is no split at {split}: give a folder such as data/128k/s that `levelproof generate` made."
        ) from None
    except (ValueError, KeyError, TypeError, OverflowError):
        raise UserError(f"The file {split / JOB} is damaged: run `levelproof generate` for this split again.") from None
    manifest = read_manifest(split, ["label"])
    labels = manifest.labels[inside(manifest.level_ids, wanted)]
    return {
        "split": str(split),
        "wanted": int((wanted[:, 1] - wanted[:, 0] + 1).sum()),
        "done": len(labels),
        "labels": dict(sorted(Counter(labels.tolist()).items())),
        "quarantined": sorted(path.name for path in (split / QUARANTINE).glob("*.txt")),
        "running": is_written(split),
        "command": job["command"],
    }


def inside(level_ids: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Whether each id lies in one of the runs (first and last id of each, ascending and apart)."""
    if not len(runs):
        return np.zeros(len(level_ids), bool)
    before = np.searchsorted(runs[:, 0], level_ids, side="right") - 1  # the last run that begins at or before an id
    return (before >= 0) & (level_ids <= runs[before, 1])
