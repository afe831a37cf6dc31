"""Lanes of a rollout act as their rule says, on a hand-made level whose expert has known probabilities."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.policy import initial, network_of
from levelproof.experts.training.rollout import ActionRule, Trajectory, rollout, start
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import ACTIONS, MOTOR_BINDINGS, concatenate_levels
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import TaskParams
from tests.experts.search.worlds import SIZE, valley
from tests.experts.small import CONFIG

GREEDY, STICKY, REHEARSING, SAMPLING = range(4)  # environments of each level
LEVELS, EPISODE, STEPS = 2, 20, 48
PREFERRED = np.array([[1, 0], [0, 1]])  # by level: an expert's most probable choices of its thrusters
SCRIPT = np.random.default_rng(0).integers(0, 2, (RECORD_STEPS, ACTIONS, LEVELS)).astype(np.int8)


def manner() -> ActionRule:
    is_kind = lambda kind: jnp.tile(jnp.arange(4) == kind, LEVELS)
    return ActionRule(is_kind(GREEDY), 1.0 * is_kind(STICKY), is_kind(REHEARSING), jnp.array(SCRIPT))


@pytest.fixture(scope="module")
def played() -> Trajectory:
    """Play both levels; before the first step, the last action was to fire both thrusters."""
    levels, network = concatenate_levels([valley(), valley()]), network_of(SIZE, CONFIG)
    first = lambda: jax.tree.map(lambda x: x[..., 0], network.constant(levels))
    shapes = jax.eval_shape(lambda: initial(jax.random.key(0), network, first()))
    params = jax.tree.map(lambda x: np.zeros((LEVELS, *x.shape), np.float32), shapes)
    likely = np.zeros((LEVELS, sum(CHOICES)), np.float32)
    for entry in (0, 1):
        likely[range(LEVELS), sum(CHOICES[: MOTOR_BINDINGS + entry]) + PREFERRED[:, entry]] = 0.2
    params["params"]["policy"]["Dense_1"]["bias"] = likely  # of the last layer; all else is 0
    acting = start(repeat(levels, 4))
    acting = acting._replace(last_action=jnp.ones_like(acting.last_action))
    rules, keys = TaskParams(max_timesteps=EPISODE), jax.random.split(jax.random.key(1), LEVELS)
    go = jax.jit(partial(rollout, network), static_argnames=("steps", "rules"))
    return jax.device_get(go(params, levels, acting, keys, manner(), steps=STEPS, rules=rules)[1])


def thrusters(played: Trajectory, environment: int) -> np.ndarray:
    """Return an environment's actions, [time, thruster, level]."""
    return np.asarray(played.action)[:, MOTOR_BINDINGS:, :, environment]


def test_greedy_lanes_take_the_most_probable_actions(played: Trajectory) -> None:
    """Those of their own level's expert, and only they: the same probabilities leave other lanes both choices."""
    assert (thrusters(played, GREEDY) == PREFERRED.T).all()
    for entry, level in np.ndindex(2, LEVELS):
        assert set(thrusters(played, SAMPLING)[:, entry, level]) == {0, 1}


def test_sticky_lanes_repeat_the_last_action_of_their_episode(played: Trajectory) -> None:
    """With a stickiness of 1 always; a new episode has none, so it begins with doing nothing."""
    first_end = np.argmax(np.asarray(played.done)[..., STICKY], axis=0)
    for level in range(LEVELS):
        assert (thrusters(played, STICKY)[: first_end[level] + 1, :, level] == 1).all()
        assert (thrusters(played, STICKY)[first_end[level] + 1 :, :, level] == 0).all()
    assert (first_end > 0).all()
    assert (first_end < EPISODE).all()


def test_rehearsing_lanes_play_the_script_from_the_start_of_each_episode(played: Trajectory) -> None:
    """But for dead entries, which are 0."""
    timestep = np.asarray(played.timestep)[..., REHEARSING]
    assert (np.sum(timestep == 0, axis=0) > 1).all()
    for level in range(LEVELS):
        of_level = SCRIPT[timestep[:, level], MOTOR_BINDINGS:, level]
        np.testing.assert_array_equal(thrusters(played, REHEARSING)[..., level], of_level)
    assert not np.asarray(played.action)[:, :MOTOR_BINDINGS].any()


def test_actions_of_sticky_and_rehearsing_lanes_are_not_the_experts_own() -> None:
    np.testing.assert_array_equal(manner().own, [True, False, False, True] * LEVELS)
