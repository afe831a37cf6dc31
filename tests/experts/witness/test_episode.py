"""Tests of first episodes played again, against whole records."""

import numpy as np
import pytest

from levelproof.experts.witness.episode import MANY, checksum_of, play_episodes
from levelproof.experts.witness.resume import paths_of
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import TaskParams, TaskState

RULES = TaskParams(max_timesteps=150)


@pytest.mark.parametrize("count", [9, MANY + 8], ids=["few lanes", "many lanes"])
def test_played_episodes_are_the_first_of_their_records(count: int) -> None:
    level, rng = sample_levels(np.arange(count), "s"), np.random.default_rng(0)
    action = rng.integers(0, np.array(CHOICES)[:, None], (256, len(CHOICES), count), dtype=np.int32)
    record = replay(level, action, RULES)
    steps = record.done.argmax(0) + 1
    names = frozenset({"reward", "goal", "timestep", "state/position", "manifold/penetration"})
    played = play_episodes(level, action, steps, RULES, names)
    lane = np.repeat(np.arange(count), steps)
    step = np.arange(len(lane)) - np.repeat(np.cumsum(steps) - steps, steps)
    rows = {
        name: np.moveaxis(np.asarray(x), -1, 1)[step, lane] for name, x in paths_of(record).items() if name in names
    }
    assert played.fields.keys() == names
    for name, values in paths_of(record).items():
        if name in names:
            rows = np.moveaxis(np.asarray(values), -1, 1)[step, lane]
            np.testing.assert_array_equal(played.fields[name], rows, name)
    assert 0 < played.reaches.sum() < count
    np.testing.assert_array_equal(played.reaches, record.goal[steps - 1, np.arange(count)])
    states = TaskState(record.state, record.timestep, record.last_distance)
    np.testing.assert_array_equal(played.checksum, checksum_of(states, steps))
    early = play_episodes(level, action, np.maximum(steps - 1, 1), RULES, frozenset())
    assert not early.reaches[steps > 1].any(), "an episode that goes on"
