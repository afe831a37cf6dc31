"""What is known of levels before their experts train: successes, and the env steps that they took to find."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from experts.labels import Source
from experts.success import Success, no_success


class Found(NamedTuple):
    """On the host, level first."""

    success: Success
    source: list[Source]  # of the success; where there is none, of the one that training may find
    scout_steps: Int[np.ndarray, " level"]
    search_steps: Int[np.ndarray, " level"]


def nothing_found(count: int) -> Found:
    """Of levels in which nobody looked."""
    zeros = np.zeros(count, np.int64)
    return Found(no_success(count), [Source.EXPLORATION] * count, zeros, zeros)


def found_by_scouts(success: Success, env_steps: Int[np.ndarray, " level"]) -> Found:
    """What scouts found."""
    source = [Source.SCOUT if length else Source.EXPLORATION for length in success.length]
    return Found(success, source, env_steps, np.zeros_like(env_steps))
