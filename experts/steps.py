"""Progress, and env steps and seconds by purpose. Imports no JAX, because the driver receives them to show progress."""

from typing import NamedTuple


class EnvSteps(NamedTuple):
    """Env steps of all lanes."""

    searched: int = 0
    trained: int = 0
    evaluated: int = 0
    idle: int = 0  # in empty slots
    replayed: int = 0  # of first episodes, where records grow from seeds

    @property
    def shown(self) -> int:
        """Env steps that a progress bar counts."""
        return self.searched + self.trained + self.replayed


class Totals(NamedTuple):
    """Progress of some levels."""

    env_steps: int
    levels: float  # decided; a level in training counts as the share of its budget used
    solved: int


class Seconds(NamedTuple):
    """Seconds of a busy worker, and so of its core or GPU."""

    sampling: float = 0.0  # sampling or reading levels, and deciding those that need no expert
    search: float = 0.0
    training: float = 0.0
    evaluation: float = 0.0
    idle: float = 0.0  # of empty slots, and of empty search slots
    replay: float = 0.0  # choosing, recording and checking witnesses
    writing: float = 0.0  # shards, experts and rows; not the fragment itself
    compiling: float = 0.0  # compiling, or reading compiled programs

    @property
    def working(self) -> float:
        """Seconds that grow with the number of levels: all but idle and compiling."""
        return self.sampling + self.search + self.training + self.evaluation + self.replay + self.writing


NO_SECONDS = Seconds()
