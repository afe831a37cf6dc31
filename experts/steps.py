"""Env steps by what they were for. Knows nothing of JAX: it travels to whoever shows progress."""

from typing import NamedTuple


class EnvSteps(NamedTuple):
    """Of all lanes."""

    scouted: int = 0
    searched: int = 0
    trained: int = 0
    evaluated: int = 0
    idle: int = 0  # in slots that had no level

    @property
    def shown(self) -> int:
        """Those that a progress bar counts."""
        return self.scouted + self.searched + self.trained
