"""Metrics of a run: JSON lines beside the policy, and the logger that the setting `log` names."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.log import GuardedLog, require_library, writer_of
from levelproof.pipeline.store.files import write

METRICS, LOG = "metrics.jsonl", "log"
STEP = "bc/updates"  # the metric that the others are plotted over


class Metrics:
    """Appends to `metrics.jsonl`. If a logger fails, the user is told once, and the run continues without it."""

    def __init__(self, folder: Path, log: str, settings: Mapping[str, Any], updates: int, say: Callable[[str], None]):
        """Open the files of a run in `folder` that has taken `updates` updates; forget what is of later ones.

        Raises:
            UserError: the logger's library is missing.
        """
        require_library(log)
        self._path, self._log = folder / METRICS, GuardedLog(log, say)
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        kept = [line for line in lines if line.endswith("}") and json.loads(line)[STEP] <= updates]
        write(self._path, "".join(f"{line}\n" for line in kept).encode())
        if log != "none":
            self._log.open(lambda: writer_of(log, folder / LOG, STEP, folder.name, settings))

    def write(self, numbers: Mapping[str, float]) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps(dict(numbers)) + "\n")
        self._log.use(lambda writer: writer.write(numbers))

    def close(self, done: bool) -> None:
        self._log.use(lambda writer: writer.close(done))
