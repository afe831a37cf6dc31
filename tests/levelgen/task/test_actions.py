"""Actions: choices, bindings, automatic motors, the mask."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.level import ACTIONS, MOTOR_BINDINGS, SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES, action_mask, controls
from levelproof.physics.types import Model


@pytest.fixture(scope="module")
def level() -> Level:
    """Size m, one lane: two joints bound to entries 2 and 0, two thrusters both bound to entry 1."""
    level = sample_levels(jnp.arange(1), SIZES["m"])
    column = lambda *values: jnp.array(values)[:, None]
    on = column(True, True)
    model = dataclasses.replace(
        level.model, joint_active=on, joint_fixed=~on, motor_on=on, thruster_active=column(True, False)
    )
    return dataclasses.replace(
        level, model=model, motor_binding=column(2, 0), motor_auto=~on, thruster_binding=column(1, 1)
    )


def act(**entries: int) -> jax.Array:
    action = np.zeros((ACTIONS, 1), np.int32)
    for name, value in entries.items():
        action[int(name[1:])] = value
    return jnp.asarray(action)


def with_model(level: Level, **changes: jax.Array) -> Level:
    model: Model = dataclasses.replace(level.model, **changes)
    return dataclasses.replace(level, model=model)


def test_choices_cover_every_entry() -> None:
    assert CHOICES == (3, 3, 3, 3, 2, 2)
    assert len(CHOICES) == ACTIONS


@pytest.mark.parametrize(("choice", "expected"), [(0, 0.0), (1, 1.0), (2, -1.0)])
def test_motor_obeys_only_its_entry(level: Level, choice: int, expected: float) -> None:
    motor, thrust = controls(level, act(e2=choice, e1=1, e3=2))
    np.testing.assert_array_equal(motor[:, 0], [expected, 0.0])
    np.testing.assert_array_equal(thrust[:, 0], [0.0, 0.0])


def test_thrusters_of_one_entry_fire_together(level: Level) -> None:
    _, thrust = controls(level, act(e5=1))
    np.testing.assert_array_equal(thrust[:, 0], [1.0, 1.0])
    _, thrust = controls(level, act(e4=1))
    np.testing.assert_array_equal(thrust[:, 0], [0.0, 0.0])


def test_automatic_motor_ignores_the_action(level: Level) -> None:
    automatic = dataclasses.replace(level, motor_auto=jnp.array([[True], [False]]))
    for choice in range(3):
        motor, _ = controls(automatic, act(e2=choice))
        np.testing.assert_array_equal(motor[:, 0], [1.0, 0.0])


def test_controls_do_not_mix_lanes(level: Level) -> None:
    two = jax.tree.map(lambda x: jnp.concatenate([x, x], -1), level)
    motor, _ = controls(two, jnp.concatenate([act(e2=1), act(e0=2)], -1))
    np.testing.assert_array_equal(motor, [[1.0, 0.0], [0.0, -1.0]])


def test_mask_is_what_active_free_joints_and_active_thrusters_obey(level: Level) -> None:
    np.testing.assert_array_equal(action_mask(level)[:, 0], [True, False, True, False, False, True])
    fixed = with_model(level, joint_fixed=jnp.array([[True], [False]]))
    np.testing.assert_array_equal(action_mask(fixed)[:MOTOR_BINDINGS, 0], [True, False, False, False])
    without = with_model(level, joint_active=jnp.zeros((2, 1), bool), thruster_active=jnp.zeros((2, 1), bool))
    assert not action_mask(without).any()


def test_mask_counts_motors_that_are_off_or_automatic(level: Level) -> None:
    """The reference's mask counts them, too, although such an entry has no effect."""
    off = with_model(level, motor_on=jnp.zeros((2, 1), bool))
    np.testing.assert_array_equal(action_mask(off), action_mask(level))
