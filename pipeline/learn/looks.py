"""The log of looks at the sealed levels, beside the policy that was measured.

To choose among policies by their sealed solve rates is to train on the sealed levels, so a published policy should say
how often it was measured on them.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from levelproof.pipeline.store.disk import NotRegular, read_regular
from levelproof.pipeline.store.files import write

LOOKS = "looks.jsonl"
SEALED = "sealed"  # name of the sealed levels, and title of those among other levels


def log_look(looks: Path, player: str, groups: Sequence[Mapping[str, Any]], attempts: int, seed: int) -> int | None:
    """Add a line to a policy's log; return how many it has. None: the file cannot be written, and nothing was.

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
    before = b""
    try:
        with suppress(FileNotFoundError):
            before = read_regular(looks)
        write(looks, before + json.dumps(look).encode() + b"\n")
    except (OSError, NotRegular):
        return None
    return before.count(b"\n") + 1
