"""Demonstrations of experts: noise is in what happens, not in what is learned."""

import jax
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.generalist.demonstrations import Demonstrations, demonstrate, demonstrations
from levelproof.experts.generalist.teachers import KnownExperts, Teacher
from levelproof.experts.imitation import MOTION, to_motion
from levelproof.experts.noise import PERTURBATION, STICKINESS
from levelproof.experts.policy import forward, most_probable, network_of
from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskState
from tests.experts.generalist.test_teachers import COUNT, EXPERT, experts_for
from tests.quick import jit_once

pytestmark = pytest.mark.slow

STICKY = np.arange(COUNT) % 2 == 0
PERTURBED = np.arange(COUNT) % 4 < 2
NO = np.zeros(COUNT, bool)


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.device_get(sample_levels(np.arange(COUNT, dtype=np.int32), "s"))


def shown(levels: Level, sticky: np.ndarray, perturbed: np.ndarray) -> Demonstrations:
    keys = jax.random.split(jax.random.key(5), COUNT)
    params = experts_for(levels).params
    return jax.device_get(demonstrate(params, levels, keys, sticky, perturbed, EXPERT, False, DEFAULT_RULES))


advance = jit_once(lambda levels, now, action: task.advance(levels, now, action.astype(int), DEFAULT_RULES))


def test_without_noise_the_chosen_actions_lead_to_the_goal_and_through_the_states_shown(levels: Level) -> None:
    one = shown(levels, NO, NO)
    assert 0 < (one.length > 0).sum() < COUNT
    now, ended = task.reset(levels), NO
    for step in range(int(one.env_steps.max())):
        assert (to_motion(now.state, False) == one.motion[step])[~ended].all()
        now, result = advance(levels, now, one.action[step])
        over = np.asarray(result.done) & ~ended
        assert (one.env_steps[over] == step + 1).all()
        assert ((one.length == step + 1) == (over & np.asarray(result.goal))).all()
        ended = ended | over
    assert (one.env_steps[~ended] == RECORD_STEPS).all()


def test_sticky_episodes_execute_the_last_action_now_and_then_and_show_the_chosen_one(levels: Level) -> None:
    one = shown(levels, STICKY, NO)
    now, executed = task.reset(levels), one.action[0]
    repeated, steps, sticks_in = NO, 12, 0
    for step in range(steps):
        if step:
            follows, sticks = (advance(levels, now, action)[0] for action in (one.action[step], executed))
            as_chosen, as_before = (
                (to_motion(after.state, False) == one.motion[step + 1]).all(1) for after in (follows, sticks)
            )
            assert (as_chosen | as_before).all()
            assert as_chosen[~STICKY].all()
            repeated = repeated | ~as_chosen
            other = (one.action[step] != executed).any(0) & (one.env_steps > step + 1) & STICKY
            sticks_in += np.array([other.sum(), (other & ~as_chosen).sum()])
            executed = np.where(as_chosen, one.action[step], executed)
        now, _ = advance(levels, now, executed)
    assert repeated.any()
    tried, stuck = sticks_in
    assert tried > 30
    assert stuck / tried == pytest.approx(STICKINESS, abs=0.2)


def test_only_perturbed_episodes_start_with_other_velocities_of_what_can_move(levels: Level) -> None:
    before = np.asarray(to_motion(task.reset(levels).state, False))
    change = (shown(levels, NO, PERTURBED).motion[0] - before).reshape(COUNT, -1, MOTION)
    assert not change[~PERTURBED].any()
    at_rest = (levels.model.inverse_mass == 0) | ~levels.model.active
    assert not change[at_rest.T].any()
    velocities = np.abs(change[PERTURBED][~at_rest.T[PERTURBED]])
    assert not velocities[:, [0, 1, 4]].any(), "places and rotations stay"
    assert 0.8 * PERTURBATION < velocities.max() <= PERTURBATION * 1.001


def test_every_level_is_shown_by_its_own_expert(levels: Level) -> None:
    known = experts_for(levels)
    certain = jax.tree.map(lambda x: 1e6 * x, known.params)
    known = KnownExperts(known.config, certain, known.expert)
    labels = demonstrations(levels, known, 0.0, 0.0, False, jax.random.key(6), DEFAULT_RULES)
    network, live = network_of(levels.size, EXPERT), np.asarray(action_mask(levels))
    start: TaskState = task.reset(levels)
    for i in range(COUNT):
        constant = jax.tree.map(lambda x, i=i: x[..., i], network.constant(levels))
        params = jax.tree.map(lambda x, i=i: x[known.expert[i]], certain)
        logits, _ = forward(network, params, constant, state_features(levels, start.state)[:, [i]])
        own = np.where(live[:, i], np.asarray(most_probable(logits))[:, 0], 0)
        np.testing.assert_array_equal(labels.action[0, :, i], own)
    assert ((labels.teacher == Teacher.EXPERT) == (labels.length > 0)).all()
    assert labels.env_steps > 0


def test_shares_of_noise_are_those_of_its_kinds(levels: Level) -> None:
    """Sticky actions change no first state; perturbed velocities change every one in which something can move."""
    known, key = experts_for(levels), jax.random.key(7)
    of = lambda sticky, perturbed: demonstrations(levels, known, sticky, perturbed, False, key, DEFAULT_RULES)
    plain, sticky, perturbed = of(0.0, 0.0), of(1.0, 0.0), of(0.0, 1.0)
    np.testing.assert_array_equal(plain.motion[0], sticky.motion[0])
    assert (plain.motion[1:8] != sticky.motion[1:8]).any()
    assert (plain.motion[0] != perturbed.motion[0]).any(1).all()
