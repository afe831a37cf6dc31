"""Metrics of a run: JSON lines and their curves beside the policy, and the logger that the setting `log` names."""

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from levelproof.pipeline.jobs.log import GuardedLog, require_library, writer_of
from levelproof.pipeline.learn.curves import Curves, draw_curves
from levelproof.pipeline.store.disk import read_regular
from levelproof.pipeline.store.files import write

METRICS, CURVES, LOG = "metrics.jsonl", "curves.png", "log"


class Metrics:
    """Appends to `metrics.jsonl`, and draws it as `curves.png`; its `with` block tells the logger how the run ended.

    If a logger fails, the user is told once, and the run continues without it.
    """

    def __init__(
        self,
        folder: Path,
        curves: Curves,
        log: str,
        settings: Mapping[str, Any],
        steps: int,
        say: Callable[[str], None],
        require_ours: Callable[[], None],
    ):
        """Open the metrics files of a run in `folder`; drop lines whose `curves.step` is beyond `steps`.

        Args:
            folder: folder of the run; another process may recreate it.
            curves: what to draw.
            log: name of a logger, or none.
            settings: settings of the run, for the logger.
            steps: of the checkpoint that the run continues.
            say: reports a sentence to the user.
            require_ours: raises if another process has recreated the folder.

        Raises:
            UserError: the logger's library is missing, or a link or the like has the name of a file.
        """
        require_library(log)
        self.step, self._require_ours = curves.step, require_ours
        self._path, self._curves, self._log = folder / METRICS, curves, GuardedLog(log, say)
        lines = read_regular(self._path).decode().splitlines() if os.path.lexists(self._path) else []
        kept = [line for line in lines if line.endswith("}") and json.loads(line).get(curves.step, math.inf) <= steps]
        write(self._path, "".join(f"{line}\n" for line in kept).encode())
        self.last: dict[str, float] = json.loads(kept[-1]) if kept else {}  # line that an earlier process wrote
        if log != "none":
            self._log.open(lambda: writer_of(log, folder / LOG, curves.step, folder.name, settings))

    def write(self, numbers: Mapping[str, float]) -> None:
        """Append a line without numbers that are not finite: NaN marks a missing one, and JSON has no NaN.

        Raises what `require_ours` raises.
        """
        self._require_ours()
        numbers = {name: number for name, number in numbers.items() if np.isfinite(number)}
        with self._path.open("a") as file:
            file.write(json.dumps(numbers) + "\n")
        self._log.use(lambda writer: writer.write(numbers))
        self._draw()

    def _draw(self) -> None:
        lines = [json.loads(line) for line in self._path.read_text().splitlines()]
        path = self._path.with_name(CURVES)
        unfinished = path.with_name(f".{CURVES}")  # ends in .png, too
        unfinished.unlink(missing_ok=True)  # what a killed process left, or a link to another file
        draw_curves(lines, self._curves, unfinished)
        unfinished.replace(path)

    def __enter__(self) -> "Metrics":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._log.use(lambda writer: writer.close(kind is None))
