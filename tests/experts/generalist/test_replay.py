"""Curricula that replay and edit levels: scores, chances, eviction, and children that wait for an attempt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof import make
from levelproof.experts.generalist.config import EvolveConfig, ReplayConfig
from levelproof.experts.generalist.curricula import EndedEpisodes, fresh
from levelproof.experts.generalist.evolve import Population, evolve
from levelproof.experts.generalist.replay import ReplayBuffer, empty, learned, replay, waiting, with_weights
from levelproof.levelgen.sampling.sampler import sample_levels, sampler
from levelproof.levelgen.task.lanes import FIRST_EXTRA, ExtendedTable, Lanes
from levelproof.levelgen.task.rules import DEFAULT_RULES

pytestmark = pytest.mark.slow

CONFIG = ReplayConfig(capacity=4, full_enough=0.5, staleness=0.0)
STALE = ReplayConfig(capacity=4, full_enough=0.5, staleness=1.0, share=0.99)
KEY = jax.random.key(0)


def episodes(*ended: tuple[int, float, float], going: int = 0) -> EndedEpisodes:
    """Return episodes as (level, return, what the critic expected), the last `going` of them under way."""
    level, gained, value = (jnp.array(column) for column in zip(*ended, strict=True))
    return EndedEpisodes(jnp.arange(len(level)) < len(level) - going, level, gained * 1.0, value * 1.0)


def scores(buffer: ReplayBuffer) -> dict[int, float]:
    levels = np.asarray(buffer.level_index).tolist()
    return {level: float(score) for level, score in zip(levels, buffer.score, strict=True) if level >= 0}


def test_levels_with_the_highest_regret_stay() -> None:
    buffer = learned(CONFIG, empty(CONFIG), episodes((10, 1, 0.9), (11, 1, 0.5), (12, 0, 0.2), (99, 1, 0), going=1))
    assert scores(buffer) == pytest.approx({10: 0.1, 11: 0.5, 12: -0.2})
    buffer = learned(CONFIG, buffer, episodes((13, 1, 0.7), (14, 1, 0.2), (15, 0, 0.9)))
    assert scores(buffer) == pytest.approx({10: 0.1, 11: 0.5, 13: 0.3, 14: 0.8}), "15 is rejected, and 12 is evicted"


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

    buffer = learned(STALE, empty(STALE), first)
    buffer = learned(STALE, learned(STALE, buffer, episodes((11, 1, 0.5))), episodes((10, 1, 0.5)))
    drawn = np.asarray(replay(STALE).draw(table, buffer, KEY, draws))
    ages = {10: 0, 11: 1, 12: 2}
    assert {level: (drawn == level).mean() for level in ages} == pytest.approx(
        {level: 0.99 * age / 3 for level, age in ages.items()}, abs=0.015
    )


EVOLVING = ReplayConfig(capacity=32)
EVOLVE = evolve(EvolveConfig(children=16), EVOLVING, sampler("s"), DEFAULT_RULES)


@pytest.mark.parametrize(
    ("share", "capacity", "enough"), [(0.9, 1000, 900), (0.07, 100, 7), (0.5, 5, 3), (0, 7, 0), (1, 7, 7)]
)
def test_share_of_slots_that_starts_replay_is_a_number_of_levels(share: float, capacity: int, enough: int) -> None:
    """In floats, 0.07 * 100 is a little more than 7."""
    assert ReplayConfig(full_enough=share, capacity=capacity).enough == enough


@pytest.mark.parametrize("temperature", [0.1, 1.0])
def test_levels_without_an_attempt_are_never_replayed(temperature: float) -> None:
    """Their weight is exactly 0, however floats round; with all ages equal staleness counts for all alike."""
    config = ReplayConfig(capacity=500, full_enough=0.0, temperature=temperature)
    rng = np.random.default_rng(0)
    for attempted in (0, 1, 250, 499, 500):
        score = np.full(500, -np.inf, np.float32)
        score[rng.choice(500, attempted, replace=False)] = rng.normal(size=attempted)
        buffer = empty(config)._replace(score=jnp.asarray(score), age=jnp.asarray(rng.integers(0, 9, 500)))
        weight = np.diff(np.asarray(with_weights(config, buffer).cumulative), prepend=0)
        assert (weight >= 0).all()
        assert not weight[score == -np.inf].any()
        assert weight.any() == (attempted > 0)
    ageless = learned(STALE, empty(STALE), episodes((10, 1, 0.9), (11, 1, 0.5)))
    assert np.diff(np.asarray(ageless.cumulative), prepend=0).tolist() == [2**29, 2**29, 0, 0]


def test_several_episodes_of_a_new_level_fill_one_slot() -> None:
    buffer = learned(CONFIG, empty(CONFIG), episodes((50, 1, 0.25), (7, 1, 0.5), (50, 0, 0.55)))
    assert np.asarray(buffer.level_index).tolist().count(50) == 1
    assert scores(buffer) == pytest.approx({50: 1 - 0.4, 7: 0.5}), (
        "its highest return, minus the mean that was expected"
    )


def test_broken_values_enter_no_score() -> None:
    buffer = learned(CONFIG, empty(CONFIG), episodes((10, 1, 0.5), (11, 1, np.nan)))
    assert scores(buffer) == pytest.approx({10: 0.5})
    assert scores(learned(CONFIG, buffer, episodes((10, 1, np.nan)))) == pytest.approx({10: 0.5})


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
    assert set(names.tolist()) <= set(np.asarray(crowd.level_index).tolist()), "waiting children are not evicted"


def test_facts_tell_how_full_and_how_edited_the_buffer_is() -> None:
    nothing = EVOLVE.facts(EVOLVE.begin())
    assert (nothing["curriculum/filled"], nothing["curriculum/replaying"]) == (0, 0)
    assert np.isnan([nothing["curriculum/score"], nothing["curriculum/edited"]]).all()
    before, after = bred()
    facts = EVOLVE.facts(before)
    assert (facts["curriculum/filled"], facts["curriculum/replaying"], facts["curriculum/edited"]) == (1, 1, 0)
    assert facts["curriculum/score"] == pytest.approx(np.mean([1 - level / 100 for level in range(32)]))
    new = np.asarray(waiting(after.buffer))
    played = after._replace(
        buffer=learned(
            EVOLVING, after.buffer, episodes(*((name, 1, 0.5) for name in np.asarray(after.buffer.level_index)[new]))
        )
    )
    assert EVOLVE.facts(after)["curriculum/filled"] == pytest.approx(1 - new.mean()), "children wait"
    assert EVOLVE.facts(played) == facts | {
        "curriculum/score": pytest.approx(np.asarray(played.buffer.score).mean()),
        "curriculum/edited": pytest.approx(new.mean()),
        "curriculum/generation": 1,
    }


def test_half_of_unreplayed_episodes_play_waiting_children() -> None:
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
