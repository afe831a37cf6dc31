"""Env steps and seconds by what they were for. Knows nothing of JAX: they travel to whoever shows progress."""

from typing import NamedTuple


class EnvSteps(NamedTuple):
    """Of all lanes."""

    searched: int = 0
    trained: int = 0
    evaluated: int = 0
    idle: int = 0  # in slots that had no level

    @property
    def shown(self) -> int:
        """Those that a progress bar counts."""
        return self.searched + self.trained


class Seconds(NamedTuple):
    """Of a worker that was busy, and with it of its core or its GPU."""

    sampling: float = 0.0  # or reading levels, and deciding those that need no expert
    search: float = 0.0
    training: float = 0.0
    evaluation: float = 0.0
    idle: float = 0.0  # of slots and of rows of the search that had no level
    replay: float = 0.0  # of witnesses: choosing, recording and checking them
    writing: float = 0.0  # of shards, experts and rows; not of the fragment itself
    compiling: float = 0.0  # or reading what was compiled before

    @property
    def working(self) -> float:
        """Seconds that grow with the number of levels: all but those idle or compiling."""
        return self.sampling + self.search + self.training + self.evaluation + self.replay + self.writing


NO_SECONDS = Seconds()
