"""Conversion to and from the reference's layout: nothing is lost, contacts keep their pairs."""

import dataclasses

import numpy as np
import pytest

from levelproof.levelgen.files.kinetix import MANIFOLDS, level_from_kinetix, state_from_kinetix, state_to_kinetix
from levelproof.levelgen.level import SIZES, Level
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import Model, Size, State
from tests.trees import assert_same

LANES = 3
INTEGERS = {
    "collision_mode",
    "n_vertices",
    "joint_a",
    "joint_b",
    "thruster_body",
    "role",
    "motor_binding",
    "thruster_binding",
}


def random_instance(kind: type, size: Size, rng: np.random.Generator, **given: object) -> object:
    """Fill a dataclass of arrays at random, with the shapes of its annotations."""
    names = {"body": size.bodies, "polygon": size.polygons, "circle": size.circles, "joint": size.joints}
    names |= {"thruster": size.thrusters, "vertex": 4, "contact": pairs_of(size).contacts, "lane": LANES}
    values = dict(given)
    for field in dataclasses.fields(kind):
        if field.name in given:
            continue
        shape = tuple(int(names.get(axis, axis)) for axis in field.type.dim_str.split())
        if field.type.dtypes == ["bool"]:
            values[field.name] = rng.random(shape) < 0.5
        elif field.name in INTEGERS:
            values[field.name] = rng.integers(0, 4, shape).astype(np.int32)
        else:
            values[field.name] = rng.normal(size=shape).astype(np.float32)
    return kind(**values)


def random_level(size: Size) -> Level:
    rng = np.random.default_rng(0)
    return random_instance(
        Level, size, rng, model=random_instance(Model, size, rng), state=random_instance(State, size, rng)
    )


@pytest.mark.parametrize("name", SIZES)
def test_conversion_round_trip_keeps_everything(name: str) -> None:
    level = random_level(SIZES[name])
    fields = state_to_kinetix(level, level.state, np.arange(LANES), np.full(LANES, -1.0))
    assert_same(level_from_kinetix(fields), level)
    assert_same(state_from_kinetix(fields), level.state)
    assert len(fields) == 82  # the reference's state has as many leaves
    assert all(len(values) == LANES for values in fields.values())


def test_contacts_keep_their_pairs() -> None:
    """Number every contact by its two bodies and its point; check where each number arrives."""
    size = SIZES["m"]
    pairs, level = pairs_of(size), random_level(size)
    labels = [(*ab, 0) for ab in zip(pairs.polygon.a, pairs.polygon.b, strict=True)]
    labels += [(*ab, 1) for ab in zip(pairs.polygon.a, pairs.polygon.b, strict=True)]
    labels += [(*ab, 0) for kind in (pairs.circle_polygon, pairs.circle) for ab in zip(kind.a, kind.b, strict=True)]
    code = np.array([100 * a + 10 * b + point for a, b, point in labels], np.float32)
    state = dataclasses.replace(level.state, contact_normal_impulse=np.repeat(code[:, None], LANES, 1))
    fields = state_to_kinetix(level, state, np.zeros(LANES), np.zeros(LANES))
    polygon, circle_polygon, circle = (fields[f"{kind}/acc_impulse_normal"][0] for kind in MANIFOLDS)
    np.testing.assert_array_equal(polygon[0], [40, 41])  # floor with polygon 4
    np.testing.assert_array_equal(polygon[-1], [450, 451])  # polygon 4 with polygon 5
    np.testing.assert_array_equal(circle_polygon[:7], [600, 610, 620, 630, 640, 650, 700])
    np.testing.assert_array_equal(circle, [670, 680, 780])


def test_converted_fields_without_effect_are_zero() -> None:
    level = random_level(SIZES["s"])
    time = np.arange(LANES)
    fields = state_to_kinetix(level, level.state, time, np.full(LANES, 2.0))
    for name in ("acc_cc_manifolds/normal", "acc_rr_manifolds/penetration", "joint/global_position"):
        assert not fields[name].any()
    assert fields["acc_rr_manifolds/normal"].shape == (*fields["acc_rr_manifolds/active"].shape, 2)
    np.testing.assert_array_equal(fields["timestep"], time)
