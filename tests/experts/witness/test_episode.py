"""Tests of first episodes played again, against whole records."""

import numpy as np
import pytest

from levelproof.experts.witness.episode import AT_ONCE, checksum_of, play_episodes
from levelproof.experts.witness.resume import paths_of
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.observe.kinds import ObservationType, observe
from levelproof.levelgen.task.rules import TaskParams, TaskState

RULES = TaskParams(max_timesteps=150)
NAMES = frozenset({"reward", "goal", "timestep", "state/position", "manifold/penetration"})


@pytest.mark.parametrize("count", [40, pytest.param(AT_ONCE + 8, marks=pytest.mark.slow)])
def test_played_episodes_are_the_first_of_their_records(count: int) -> None:
    """40 episodes are more than the lanes that few have, and AT_ONCE + 8 are played in two groups."""
    level, rng = sample_levels(np.arange(count), "s"), np.random.default_rng(0)
    action = rng.integers(0, np.array(CHOICES)[:, None], (256, len(CHOICES), count), dtype=np.int32)
    record = replay(level, action, RULES)
    steps = record.done.argmax(0) + 1
    played = play_episodes(level, action, steps, RULES, NAMES, ObservationType.SYMBOLIC_FLAT)
    lane = np.repeat(np.arange(count), steps)
    step = np.arange(len(lane)) - np.repeat(np.cumsum(steps) - steps, steps)
    assert played.fields.keys() == NAMES
    for name, values in paths_of(record).items():
        if name in NAMES:
            rows = np.moveaxis(np.asarray(values), -1, 1)[step, lane]
            np.testing.assert_array_equal(played.fields[name], rows, name)
    np.testing.assert_array_equal(played.reaches, record.goal[steps - 1, np.arange(count)])
    states = TaskState(record.state, record.timestep, record.last_distance)
    np.testing.assert_array_equal(played.checksum, checksum_of(states, steps))
    first = observe(ObservationType.SYMBOLIC_FLAT, level, level.state)
    np.testing.assert_array_equal(played.observation[step == 0], np.asarray(first).T)


def test_episodes_that_end_elsewhere_do_not_reach_the_goal() -> None:
    level, rng = sample_levels(np.arange(40), "s"), np.random.default_rng(0)
    action = rng.integers(0, np.array(CHOICES)[:, None], (256, len(CHOICES), 40), dtype=np.int32)
    record = replay(level, action, RULES)
    steps = record.done.argmax(0) + 1
    reached = record.goal[steps - 1, np.arange(40)]
    assert 1 < reached.sum() < 40
    for stated in np.maximum(steps - 1, 1), np.minimum(steps + 1, 256):
        reaches = play_episodes(level, action, stated, RULES, frozenset()).reaches
        assert not reaches[stated != steps].any()
