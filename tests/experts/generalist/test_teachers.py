"""Teachers of a policy at any state: what they label replays to the goal from that very state."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.evaluation import Moment
from levelproof.experts.generalist import teachers
from levelproof.experts.generalist.attempts import Found, play_expert, recalled
from levelproof.experts.generalist.teachers import (
    Asked,
    KnownExperts,
    Labels,
    Teacher,
    TeachersConfig,
    label_states,
    no_experts,
    replay_from,
)
from levelproof.experts.generalist.visited import draw_states, state_at
from levelproof.experts.imitation import from_motion
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.experts.policy import forward, initial, network_of, sample
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.level import ACTIONS, Level, Role
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskState
from tests.quick import jit_once

pytestmark = pytest.mark.slow

COUNT = 16
SEARCH = TeachersConfig(witness=2, random=16, learner=0)
AT = np.arange(COUNT, dtype=np.int32) * 2  # env steps after which teachers are asked
EXPERT = ExpertConfig(width=4, depth=1)


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.device_get(sample_levels(np.arange(COUNT, dtype=np.int32), "s"))


@pytest.fixture(scope="module")
def asked(levels: Level) -> Asked:
    """Return states in the middle of episodes of held random actions, which are the witnesses, too."""
    action = np.random.default_rng(0).integers(0, 2, (RECORD_STEPS // 16, ACTIONS, COUNT)).astype(np.int8)
    action = np.repeat(action, 16, 0)
    now = jax.device_get(state_at(levels, action, AT, DEFAULT_RULES))
    assert (now.timestep == AT).all()
    return Asked(levels, now, action)


def labelled(asked: Asked, config: TeachersConfig = SEARCH, experts: KnownExperts | None = None) -> Labels:
    experts = experts or no_experts(COUNT)
    return label_states(asked, experts, None, NetworkConfig(), config, jax.random.key(1), DEFAULT_RULES)


@pytest.fixture(scope="module")
def labels(asked: Asked) -> Labels:
    return labelled(asked)


def test_labels_reach_the_goal_from_the_state_and_not_before(asked: Asked, labels: Labels) -> None:
    assert 1 < (labels.length > 0).sum() < COUNT
    assert {Teacher.WITNESS, Teacher.RANDOM} <= set(labels.teacher.tolist())
    step = jit_once(lambda now, action: task.advance(asked.level, now, action, DEFAULT_RULES))
    now, open_ = asked.now, labels.length > 0
    for number in range(int(labels.length.max())):
        own = from_motion(labels.motion[number], asked.level.size)
        for name in ("position", "velocity", "rotation", "angular_velocity"):
            seen, there = (np.asarray(getattr(state, name))[..., open_] for state in (own, now.state))
            np.testing.assert_array_equal(seen, there)
        now, result = step(now, jnp.asarray(labels.action[number], jnp.int32))
        ends = open_ & (labels.length == number + 1)
        assert np.asarray(result.goal)[ends].all()
        assert not (np.asarray(result.done) & open_ & ~ends).any()
        open_ &= ~ends
    assert not open_.any()


def test_success_of_another_length_is_no_label(asked: Asked, labels: Labels) -> None:
    reached = labels.length > 0
    for longer in (-1, 0, 1):
        length = np.where(reached, labels.length + longer, 0).astype(np.int32)
        right, _ = replay_from(asked.level, asked.now, Found(labels.action, length), False, DEFAULT_RULES)
        np.testing.assert_array_equal(right, reached if not longer else np.zeros(COUNT, bool))


def test_shortest_success_of_several_teachers_is_the_label(asked: Asked, labels: Labels) -> None:
    alone = {
        Teacher.WITNESS: labelled(asked, replace(SEARCH, random=0)).length,
        Teacher.RANDOM: labelled(asked, replace(SEARCH, witness=0)).length,
    }
    lengths = np.where(np.array([*alone.values()]) > 0, np.array([*alone.values()]), RECORD_STEPS + 1)
    shortest = lengths.min(0)
    np.testing.assert_array_equal(labels.length, np.where(shortest <= RECORD_STEPS, shortest, 0))
    first = np.array([*alone])[lengths.argmin(0)]
    np.testing.assert_array_equal(labels.teacher, np.where(labels.length, first, Teacher.NONE))


def test_states_are_labelled_the_same_in_small_blocks(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SEARCH, random=0)
    together = labelled(asked, config)
    monkeypatch.setattr(teachers, "AT_ONCE", 5)
    apart = labelled(asked, config)
    assert apart.env_steps == together.env_steps
    np.testing.assert_array_equal(apart.teacher, together.teacher)
    np.testing.assert_array_equal(apart.length, together.length)
    for i, length in enumerate(together.length):  # what follows the goal is not read
        np.testing.assert_array_equal(apart.action[:length, :, i], together.action[:length, :, i])
        np.testing.assert_array_equal(apart.motion[:length, i], together.motion[:length, i])


def test_labels_use_no_more_env_steps_than_the_episode_has_left(asked: Asked, labels: Labels) -> None:
    late = asked._replace(now=replace(asked.now, timestep=np.full(COUNT, RECORD_STEPS - 2, np.int32)))
    assert labelled(late).length.max() <= 2 < labels.length.max()


def test_level_without_a_goal_has_no_label(asked: Asked, labels: Labels) -> None:
    """Where no teacher reaches the goal, there is no label, whatever the teachers did."""
    role = np.where(asked.level.role == Role.BLUE, Role.PLAIN, asked.level.role)
    without = labelled(asked._replace(level=replace(asked.level, role=role)))
    assert not without.length.any()
    assert (without.teacher == Teacher.NONE).all()
    assert without.env_steps > labels.env_steps


def test_witness_labels_its_own_first_state(asked: Asked, levels: Level) -> None:
    record = replay(levels, asked.witness)
    ends = record.done.argmax(0)
    solved = record.goal[ends, np.arange(COUNT)]
    start = jax.device_get(task.reset(levels))
    labels = labelled(asked._replace(now=start), replace(SEARCH, random=0))
    assert solved.any()
    assert (labels.teacher[solved] == Teacher.WITNESS).all()
    assert (labels.length[solved] <= ends[solved] + 1).all()


def test_first_variation_of_a_witness_is_the_witness() -> None:
    varied = recalled(np.zeros((RECORD_STEPS, ACTIONS, 2), np.int8), 8)
    assert (np.asarray(varied.shift)[::8] == 0).all()
    assert (np.asarray(varied.noise)[::8] == 0).all()
    assert (np.diff(np.asarray(varied.noise)[:8]) > 0).all()
    assert len(np.unique(varied.shift)) > 4


def experts_for(levels: Level) -> KnownExperts:
    """Return an expert of each level with random weights, in the reverse order of the levels."""
    network = network_of(levels.size, EXPERT)
    constant = jax.tree.map(lambda x: x[..., 0], network.constant(levels))
    begin = jit_once(jax.vmap(lambda key: initial(key, network, constant)))
    return KnownExperts(
        EXPERT, jax.device_get(begin(jax.random.split(jax.random.key(2), COUNT))), np.arange(COUNT)[::-1]
    )


def test_expert_is_asked_first_and_only_in_its_own_level(asked: Asked, levels: Level) -> None:
    known = experts_for(levels)
    known = known._replace(expert=np.where(np.arange(COUNT) % 2, known.expert, -1))
    labels = labelled(asked, TeachersConfig(expert=16, witness=2, random=0, learner=0), known)
    by_expert = labels.teacher == Teacher.EXPERT
    assert by_expert.any()
    assert not by_expert[::2].any()
    alone = labelled(asked, TeachersConfig(expert=16, witness=0, random=0, learner=0), known)
    assert (alone.teacher == np.where(by_expert, Teacher.EXPERT, Teacher.NONE)).all()
    assert (alone.length[by_expert] == labels.length[by_expert]).all()


def test_play_expert_gives_every_state_its_own_expert(levels: Level) -> None:
    known, attempts = experts_for(levels), 2
    lanes = jax.tree.map(lambda x: np.repeat(x, attempts, -1), levels)
    now = TaskState(lanes.state, jnp.zeros(COUNT * attempts, jnp.int32), jnp.zeros(COUNT * attempts))
    uniform = jax.random.uniform(jax.random.key(3), (ACTIONS, COUNT * attempts))
    act = jit_once(lambda params: play_expert(EXPERT)(params, Moment(lanes, now, uniform.astype(int), uniform)))
    actions = np.asarray(act(known.params))
    network = network_of(levels.size, EXPERT)
    for i in (0, COUNT - 1):
        constant = jax.tree.map(lambda x, i=i: x[..., i], network.constant(levels))
        params = jax.tree.map(lambda x, i=i: x[i], known.params)
        own = slice(i * attempts, (i + 1) * attempts)
        logits, _ = forward(network, params, constant, state_features(lanes, lanes.state)[:, own])
        np.testing.assert_array_equal(actions[:, own], sample(logits, uniform[:, own]))


def test_states_are_drawn_from_failures_by_share_and_before_the_end() -> None:
    steps, solved = np.array([5, 200, 1, 30]), np.array([True, False, False, True])
    episode, at = draw_states(np.random.default_rng(0), steps, solved, 1000, 0.9)
    assert (~solved[episode]).sum() == 900
    assert (at < steps[episode]).all()
    assert at[episode == 1].max() > 190
    for all_alike in (True, False):
        episode, _ = draw_states(np.random.default_rng(0), steps, np.full(4, all_alike), 100, 0.9)
        assert set(episode.tolist()) == {0, 1, 2, 3}


def test_teachers_config_needs_a_teacher() -> None:
    with pytest.raises(ValueError, match="let at least one of them teach"):
        TeachersConfig(0, 0, 0, 0)
