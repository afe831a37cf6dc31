"""The benchmark of fresh levels: every way plays on, and ends episodes at about the same rate."""

import jax
import numpy as np
import pytest

import levelproof
from benchmarks import fresh
from levelproof.levelgen.task.rules import TaskParams


@pytest.mark.campaign
@pytest.mark.parametrize("levels", ["table", "fresh"])
def test_ways_end_as_many_episodes(levels: str) -> None:
    given = levelproof.sample_levels(np.arange(64), "s") if levels == "table" else "s"
    env, params = levelproof.make(given, rules=TaskParams(max_timesteps=16))
    over = []
    for episodes, play in (fresh.mapped(env, params, 64), fresh.in_lanes(env, params, 64, 64)):
        for turn in range(2):
            episodes, ended = play(episodes, jax.random.key(turn))
            over.append(int(ended) / (64 * fresh.STEPS))
    assert min(over) >= 1 / 16
    assert max(over) < 2 / 16
