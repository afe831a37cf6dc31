"""Curricula that replay and edit levels: scores, chances, who gives way, and children that wait for an attempt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof import make
from levelproof.experts.generalist.config import EvolveConfig, ReplayConfig
from levelproof.experts.generalist.curricula import EndedEpisodes, fresh
from levelproof.experts.generalist.evolve import Population, evolve
from levelproof.experts.generalist.replay import ReplayBuffer, empty, learned, replay, waiting
from levelproof.levelgen.sampling.sampler import sample_levels, sampler
from levelproof.levelgen.task.lanes import FIRST_EXTRA, ExtendedTable, Lanes
from levelproof.levelgen.task.rules import DEFAULT_RULES

CONFIG = ReplayConfig(capacity=4, full_enough=0.5, staleness=0.0)
KEY = jax.random.key(0)


def episodes(*ended: tuple[int, float, float], going: int = 0) -> EndedEpisodes:
    """Return episodes as (level, return, mean value), the last `going` of them under way."""
    level, gained, value = (jnp.array(column) for column in zip(*ended, strict=True))
    return EndedEpisodes(jnp.arange(len(level)) < len(level) - going, level, gained * 1.0, value * 1.0)


def scores(buffer: ReplayBuffer) -> dict[int, float]:
    levels = np.asarray(buffer.level_index).tolist()
    return {level: float(score) for level, score in zip(levels, buffer.score, strict=True) if level >= 0}


def test_levels_with_the_highest_regret_stay() -> None:
    buffer = learned(CONFIG, empty(CONFIG), episodes((10, 1, 0.9), (11, 1, 0.5), (12, 0, 0.2), (99, 1, 0), going=1))
    assert scores(buffer) == pytest.approx({10: 0.1, 11: 0.5, 12: -0.2})
    buffer = learned(CONFIG, buffer, episodes((13, 1, 0.7), (14, 1, 0.2), (15, 0, 0.9)))
    assert scores(buffer) == pytest.approx({10: 0.1, 11: 0.5, 13: 0.3, 14: 0.8}), "12 gives way, and 15 stays out"


def test_score_is_the_highest_return_minus_the_mean_value() -> None:
    """A level that was solved once keeps its regret when it is lost again; two episodes count equally."""
    buffer = learned(CONFIG, empty(CONFIG), episodes((10, 1, 0.5)))
    buffer = learned(CONFIG, buffer, episodes((10, 0, 0.25)))
    assert scores(buffer) == pytest.approx({10: 0.75})
    buffer = learned(CONFIG, buffer, episodes((10, 2, 0.5), (10, 0, 0.0)))
    assert scores(buffer) == pytest.approx({10: 2 - 0.25})


def test_chances_follow_ranks_and_ages() -> None:
    table, draws = sampler("s"), 20_000
    first = episodes((10, 1, 0.9), (11, 1, 0.5), (12, 1, 0.7))
    curriculum = replay(CONFIG)
    few = learned(CONFIG, empty(CONFIG), episodes((10, 1, 0.9)))
    drawn = np.asarray(curriculum.draw(table, few, KEY, draws))
    assert (drawn != 10).all(), "a quarter of the buffer is not enough"
    drawn = np.asarray(curriculum.draw(table, learned(CONFIG, few, first), KEY, draws))
    share = {level: (drawn == level).mean() for level in (10, 11, 12)}
    sum_of_ranks = 1 + 1 / 2 + 1 / 3
    expected = {11: 0.5 / sum_of_ranks, 12: 0.5 / 2 / sum_of_ranks, 10: 0.5 / 3 / sum_of_ranks}
    assert share == pytest.approx(expected, abs=0.015)

    stale = ReplayConfig(capacity=4, full_enough=0.5, staleness=1.0, share=1.0)
    buffer = learned(stale, empty(stale), first)
    buffer = learned(stale, learned(stale, buffer, episodes((11, 1, 0.5))), episodes((10, 1, 0.5)))
    drawn = np.asarray(replay(stale).draw(table, buffer, KEY, draws))
    ages = {10: 0, 11: 1, 12: 2}
    assert {level: (drawn == level).mean() for level in ages} == pytest.approx(
        {level: age / 3 for level, age in ages.items()}, abs=0.015
    )


EVOLVING = ReplayConfig(capacity=32)
EVOLVE = evolve(EvolveConfig(children=16), EVOLVING, sampler("s"), DEFAULT_RULES)


def bred() -> tuple[Population, Population]:
    """Return a population of random levels before and after a generation of children."""
    now = EVOLVE.learn(EVOLVE.begin(), episodes(*((level, 1, level / 100) for level in range(EVOLVING.capacity))))
    assert EVOLVE.breed
    return now, EVOLVE.breed(now, np.random.default_rng(0))


def test_children_take_the_slots_of_low_scores_and_wait() -> None:
    before, after = bred()
    new = np.asarray(waiting(after.buffer))
    assert 4 <= new.sum() < 16, "some children cannot be played"
    gone = set(np.asarray(before.buffer.level_index).tolist()) - set(np.asarray(after.buffer.level_index).tolist())
    assert gone == set(range(32 - new.sum(), 32)), "a high value is a low regret"
    names = np.asarray(after.buffer.level_index)[new]
    assert (names >= FIRST_EXTRA).all()
    assert np.array_equal((names - FIRST_EXTRA) % 32, np.flatnonzero(new))
    crowd = learned(EVOLVING, after.buffer, episodes(*((1000 + level, 1, -1) for level in range(40))))
    assert set(names.tolist()) <= set(np.asarray(crowd.level_index).tolist()), "who waits does not give way"


def test_half_of_what_is_not_replayed_are_children_that_wait() -> None:
    _, after = bred()
    drawn = np.asarray(EVOLVE.draw(EVOLVE.table(sampler("s"), after), after, KEY, 20_000))
    known, new = (np.asarray(after.buffer.level_index)[x] for x in (~waiting(after.buffer), waiting(after.buffer)))
    counts = [np.isin(drawn, each).mean() for each in (known, new)]
    assert counts == pytest.approx([0.5, 0.25], abs=0.015)
    assert np.unique(drawn[np.isin(drawn, new)]).size == len(new)


def test_a_child_is_scored_by_its_own_episodes_only() -> None:
    _, after = bred()
    name = int(np.asarray(after.buffer.level_index)[np.asarray(waiting(after.buffer))][0])
    played = learned(EVOLVING, after.buffer, episodes((name, 1, 0.25), (name + 32, 1, -5)))
    assert scores(played)[name] == pytest.approx(0.75)
    assert name + 32 not in scores(played), "an earlier or later child of the same slot is unknown"


def test_lanes_play_children_and_random_levels_of_one_table() -> None:
    _, after = bred()
    slots = np.flatnonzero(waiting(after.buffer))[:2]
    index = jnp.array([int(after.buffer.level_index[slots[0]]), 7, int(after.buffer.level_index[slots[1]]), 8])
    lanes = Lanes(make(sampler("s"))[0])
    _, state, played = lanes.reset(ExtendedTable(sampler("s"), after.levels), index)
    random = sample_levels([7, 8], "s")
    expected = [after.levels.state.position[..., slots[0]], random.state.position[..., 0]]
    expected += [after.levels.state.position[..., slots[1]], random.state.position[..., 1]]
    assert np.array_equal(state.now.state.position, np.stack(expected, -1))
    assert np.array_equal(played.level.role[:, 0], after.levels.role[:, slots[0]])


def test_fresh_levels_are_drawn_while_nothing_is_known() -> None:
    curriculum, table = replay(CONFIG), sampler("s")
    drawn = np.asarray(curriculum.draw(table, curriculum.begin(), KEY, 1000))
    assert np.array_equal(drawn, fresh(table, jax.random.split(KEY, 3)[0], 1000))
