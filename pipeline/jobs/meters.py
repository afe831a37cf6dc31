"""A job's progress as Prometheus gauges, exported through the cluster's own metrics. Knows nothing of Ray."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.progress import Tally


class Meters:
    """Gauges of one split's progress."""

    def __init__(self, split: Path, gauge: Callable[[str, str, tuple[str, ...]], Any]) -> None:
        """`gauge` creates a gauge from its name, its description and the names of its tags."""
        self._split = {"split": "/".join(split.parts[-2:])}
        meanings = {"levels": "levels committed", "solved": "of them solved", "env_steps": "env steps of this run"}
        self._gauges = {name: gauge(f"levelproof_{name}", what, ("split",)) for name, what in meanings.items()}

    def show(self, tally: Tally) -> None:
        for name, value in {"levels": tally.done, "solved": tally.solved, "env_steps": tally.steps}.items():
            self._gauges[name].set(value, self._split)
