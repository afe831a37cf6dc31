"""The log of looks at the sealed levels, beside the policy that was measured.

To choose among policies by their sealed solve rates is to train on the sealed levels, so a published policy should say
how often it was measured on them.
"""

import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from levelproof.pipeline.store.disk import NotRegular, read_regular, regular

LOOKS = "looks.jsonl"
SEALED = "sealed"  # name of the sealed levels, and title of those among other levels


def log_look(looks: Path, player: str, groups: Sequence[Mapping[str, Any]], attempts: int, seed: int) -> int | None:
    """Add a line to a policy's log; return the number of its lines, or None if it cannot be written.

    Args:
        looks: the log.
        player: name of the policy among the players.
        groups: what `evaluate` found on each group of sealed levels.
        attempts: at each level.
        seed: of the attempts.
    """
    rates = {
        group["levels"]: {"levels": sampled["levels"], "solved": sampled["once"]["rate"]}
        for group in groups
        for sampled in [group["of"].get(SEALED, group["of"]["all"])[player]]  # of a split, only those that are sealed
    }
    look = {"at": datetime.now(UTC).isoformat(timespec="seconds"), "attempts": attempts, "seed": seed, "on": rates}
    try:
        with open(looks, "a+b", opener=regular) as file:  # other evaluations may append at the same time
            file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
            cut_off = file.read(1) not in (b"", b"\n")  # an earlier line, by a full disk
            file.write(b"\n" * cut_off + json.dumps(look).encode() + b"\n")
        return read_regular(looks).count(b"\n")
    except (OSError, NotRegular):
        return None
