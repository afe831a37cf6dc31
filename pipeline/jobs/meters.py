"""A job's progress as Prometheus gets it from a cluster's own metrics. Knows nothing of Ray."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.progress import Tally


class Meters:
    """Gauges of one split's progress."""

    def __init__(self, split: Path, gauge: Callable[[str, str, tuple[str, ...]], Any]) -> None:
        """`gauge` makes one of its name, its meaning and the names of its tags."""
        self._split = {"split": "/".join(split.parts[-2:])}
        about = {"levels": "levels committed", "solved": "of them solved", "env_steps": "env steps of this run"}
        self._gauges = {name: gauge(f"levelproof_{name}", what, ("split",)) for name, what in about.items()}

    def show(self, tally: Tally) -> None:
        for name, value in {"levels": tally.done, "solved": tally.solved, "env_steps": tally.steps}.items():
            self._gauges[name].set(value, self._split)
