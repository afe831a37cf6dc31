"""Metrics of a run: JSON lines beside the policy, and the logger that the setting `log` names."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.log import ScalarWriter, require_library, writer_of

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
        self._path, self._say, self._writer = folder / METRICS, say, None
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        kept = [line for line in lines if line.endswith("}") and json.loads(line)[STEP] <= updates]
        self._path.write_text("".join(f"{line}\n" for line in kept))
        if log != "none":
            self._try(lambda: self._open(writer_of(log, folder / LOG, STEP, folder.name, settings)))

    def write(self, numbers: Mapping[str, float]) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps(dict(numbers)) + "\n")
        if writer := self._writer:
            self._try(lambda: writer.write(numbers))

    def close(self, done: bool) -> None:
        if writer := self._writer:
            self._try(lambda: writer.close(done))

    def _open(self, writer: ScalarWriter) -> None:
        self._writer = writer
        self._say(f"Scalars: {writer.place}")

    def _try(self, act: Callable[[], None]) -> None:
        try:
            act()
        except Exception as error:  # libraries raise types of their own
            self._writer, reason = None, (str(error).strip().splitlines() or [type(error).__name__])[-1].rstrip(".")
            self._say(f"Cannot log ({reason}): the run continues without a log.")
