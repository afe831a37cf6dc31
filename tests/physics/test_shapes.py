"""A step refuses arrays that do not fit its size, before generated code reads or writes out of bounds."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.physics.block import Inputs
from levelproof.physics.step import as_machine_code, on_all_lanes, step
from levelproof.physics.types import Params
from tests.physics.worlds import idle, room

LANES = 3
Change = Callable[[Inputs], Inputs]
WAYS = [as_machine_code, on_all_lanes]


def world() -> Inputs:
    return Inputs(*room(LANES), *idle(LANES))


def state(**arrays: Any) -> Change:
    return lambda given: given._replace(before=replace(given.before, **arrays))


def shape(field: str, *dimensions: int) -> Change:
    return lambda given: state(**{field: np.zeros(dimensions, getattr(given.before, field).dtype)})(given)


BODIES, CONTACTS = world().before.rotation.shape[0], world().before.contact_active.shape[0]
WRONG: dict[str, Change] = {
    "before.contact_active": shape("contact_active", 1, LANES),
    "before.contact_normal_impulse": shape("contact_normal_impulse", CONTACTS + 1, LANES),
    "before.rotation": shape("rotation", BODIES, LANES - 1),
    "before.velocity": shape("velocity", BODIES, LANES),
    "before.joint_angular_impulse": shape("joint_angular_impulse"),
    "motor": lambda given: given._replace(motor=given.motor[:-1]),
    "model.gravity": lambda given: given._replace(model=replace(given.model, gravity=np.zeros((3, 1), np.float32))),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", WRONG)
def test_step_refuses_an_array_of_another_shape(name: str, way: Callable[..., Any]) -> None:
    given = WRONG[name](world())
    with pytest.raises(ValueError, match=rf"^{re.escape(name)} has shape \(.*\), but must be \(.*{LANES}\)"):
        jax.eval_shape(lambda: way(given, Params(), True))


@pytest.mark.parametrize("way", WAYS)
def test_step_refuses_an_array_of_another_dtype(way: Callable[..., Any]) -> None:
    given = world()
    given = state(contact_active=np.zeros((CONTACTS, LANES), np.float32))(given)
    with pytest.raises(TypeError, match=r"^before\.contact_active is float32, but must be bool"):
        jax.eval_shape(lambda: way(given, Params(), True))


def test_public_step_checks_shapes() -> None:
    given = WRONG["before.contact_active"](world())
    with pytest.raises(ValueError, match=r"^before\.contact_active has shape \(1, 3\)"):
        step(*given)  # pyright: ignore[reportArgumentType]


def test_arrays_of_one_lane_broadcast() -> None:
    given = world()
    one = given._replace(model=jax.tree.map(lambda x: x[..., :1], given.model))
    after, _ = jax.eval_shape(lambda: step(*one))  # pyright: ignore[reportArgumentType]
    assert after.rotation.shape == (BODIES, LANES)


def test_step_refuses_64_bit_mode() -> None:
    with jax.enable_x64(True), pytest.raises(ValueError, match="jax_enable_x64 is on"):
        jax.eval_shape(step, *world())
