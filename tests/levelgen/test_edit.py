"""Edits of levels: joined bodies stay joined, and the engine and level files accept every result."""

import math
from contextlib import suppress
from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.levelgen.edit import (
    EDITS,
    EditError,
    add_body,
    add_joint,
    add_thruster,
    bind,
    bodies_at,
    delete,
    fix,
    move,
    one_of,
    resize,
    set_role,
    turn,
)
from levelproof.levelgen.files.level_file import LevelFile, from_document, to_document
from levelproof.levelgen.frames import in_world
from levelproof.levelgen.level import MOTOR_BINDINGS, SIZES, THRUSTER_BINDINGS, Level, Role
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.rules import TaskParams, advance, reset

M = SIZES["m"]
FIRST = 4  # the first polygon that is not scenery


def empty() -> Level:
    return empty_level(M, 1)


def joined() -> Level:
    """Return a circle joined by a motor to a rectangle's corner, and a thruster on the rectangle."""
    level = add_body(add_body(empty(), "rectangle", 2.0, 2.0), "circle", 2.2, 2.2)
    return add_thruster(add_joint(level, 2.2, 2.2), 1.9, 1.9, math.pi / 2)


def gap(level: Level) -> float:
    """Return the distance between the ends of the first joint, m."""
    one, ends = one_of(level), []
    model = one.model
    for bodies, anchors in ((model.joint_a, model.joint_anchor_a), (model.joint_b, model.joint_anchor_b)):
        angle = one.state.rotation[bodies[0]]
        turned = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))) @ anchors[0]
        ends.append(one.state.position[bodies[0]] + turned)
    return float(np.abs(ends[0] - ends[1]).max())


def test_body_joined_to_the_scenery_cannot_be_moved() -> None:
    """The scenery cannot be moved; only the joint may be deleted."""
    level = one_of(joined())
    level.model.joint_b[0] = 2  # the right wall
    held = int(level.model.joint_a[0])
    level = jax.tree.map(lambda x: x[..., None], level)
    for edit in (lambda: move(level, held, 1, 1), lambda: turn(level, held, 0.3), lambda: resize(level, held, 1.5)):
        with pytest.raises(EditError, match="Joints hold this body to the scenery"):
            edit()
    fix(level, held, True)


def test_added_body_has_the_mass_of_its_shape() -> None:
    one = one_of(add_body(add_body(empty(), "rectangle", 1, 2), "circle", 3, 2))
    assert one.model.inverse_mass[FIRST] == pytest.approx(1 / 0.25)
    assert one.model.inverse_mass[M.polygons] == pytest.approx(1 / (math.pi * 0.25**2))
    assert one.state.position[FIRST].tolist() == [1, 2]


def test_joined_bodies_move_turn_and_resize_together() -> None:
    level = joined()
    assert not one_of(level).model.collides[FIRST, M.polygons]
    moved, turned = move(level, FIRST, 3, 3), turn(level, M.polygons, 1.0)
    for after in (moved, turned, resize(level, FIRST, 1.5), resize(level, M.polygons, 0.5)):
        assert gap(after) < 1e-5
    assert one_of(moved).state.position[M.polygons] == pytest.approx([3.2, 3.2])
    before, after = one_of(level).state, one_of(turned).state
    pair = [FIRST, M.polygons]
    assert after.rotation[pair] == pytest.approx(before.rotation[pair] + 1.0)
    arm = before.position[FIRST] - before.position[M.polygons]
    cos, sin = math.cos(1.0), math.sin(1.0)
    assert after.position[FIRST] - after.position[M.polygons] == pytest.approx(
        arm @ np.array([[cos, sin], [-sin, cos]]), rel=1e-5
    )


@pytest.mark.parametrize("body", [FIRST, M.polygons])
def test_resized_body_has_the_mass_of_its_new_shape(body: int) -> None:
    before, after = (one_of(each).model for each in (joined(), resize(joined(), body, 1.5)))
    assert after.inverse_mass[body] == pytest.approx(before.inverse_mass[body] / 1.5**2)
    assert after.inverse_inertia[body] == pytest.approx(before.inverse_inertia[body] / 1.5**4)
    fixed = one_of(resize(fix(joined(), body, True), body, 1.5)).model
    assert fixed.inverse_mass[body] == fixed.inverse_inertia[body] == 0


def test_delete_removes_a_body_with_its_joints_and_thrusters() -> None:
    one = one_of(delete(joined(), "body", FIRST))
    assert not one.model.joint_active.any()
    assert not one.model.thruster_active.any()
    assert one.model.collides[FIRST, M.polygons]


def test_set_role_and_fix_change_one_body() -> None:
    level = fix(set_role(joined(), FIRST, Role.GREEN), FIRST, True)
    one = one_of(level)
    assert one.role[FIRST] == Role.GREEN
    assert one_of(set_role(empty(), 0, Role.RED)).role[0] == Role.RED  # of the scenery
    assert one.model.inverse_mass[FIRST] == 0
    assert bodies_at(level, 2.2, 2.2) == [M.polygons, FIRST]  # immovable bodies are drawn first
    assert one_of(fix(level, FIRST, False)).model.inverse_mass[FIRST] == pytest.approx(4)


def test_fixed_body_stays_where_it_is_even_if_it_moved() -> None:
    level = add_body(empty(), "rectangle", 2, 2)
    moving = replace(level.state, velocity=level.state.velocity + 1, angular_velocity=level.state.angular_velocity + 1)
    still = fix(replace(level, state=moving), FIRST, True)
    after = advance(still, reset(still), np.zeros((6, 1), np.int32), TaskParams())[0].state
    np.testing.assert_array_equal(after.position[FIRST], still.state.position[FIRST])
    np.testing.assert_array_equal(after.rotation[FIRST], still.state.rotation[FIRST])


def test_bind_changes_the_entry_of_one_actuator() -> None:
    level = joined()
    motors, thrusters = level.motor_binding.copy(), level.thruster_binding.copy()
    motors[0], thrusters[0] = 2, 1
    motor, thruster = bind(level, "joint", 0, MOTOR_BINDINGS + 2), bind(level, "thruster", 0, THRUSTER_BINDINGS + 1)
    np.testing.assert_array_equal(motor.motor_binding, motors)
    np.testing.assert_array_equal(motor.thruster_binding, level.thruster_binding)
    np.testing.assert_array_equal(thruster.motor_binding, level.motor_binding)
    np.testing.assert_array_equal(thruster.thruster_binding, thrusters)


def test_fixed_joint_keeps_the_angle_between_its_bodies() -> None:
    level = add_body(turn(add_body(empty(), "rectangle", 2.0, 2.0), FIRST, 0.4), "circle", 2.2, 2.2)
    level = add_joint(turn(level, M.polygons, -0.5), 2.15, 2.15, True)
    assert level.model.joint_fixed[0].all()
    assert not level.model.motor_on[0].any()
    after = advance(level, reset(level), np.zeros((6, 1), np.int32), TaskParams())[0].state
    assert float(after.rotation[M.polygons, 0] - after.rotation[FIRST, 0]) == pytest.approx(-0.9, abs=1e-3)


def test_thruster_on_a_turned_body_is_where_it_was_put() -> None:
    one = one_of(add_thruster(turn(add_body(empty(), "rectangle", 2.0, 2.0), FIRST, 1.0), 2.1, 2.05, 0.3))
    assert one.model.thruster_rotation[0] + one.state.rotation[FIRST] == pytest.approx(0.3)
    assert in_world(one.state, FIRST, one.model.thruster_position[0]) == pytest.approx([2.1, 2.05])


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda: move(empty(), 0, 1, 1), "scenery"),
        (lambda: move(empty(), FIRST, 1, 1), "no body 4"),
        (lambda: add_body(empty(), "hexagon", 1, 1), "choose circle"),
        (lambda: add_joint(empty(), 1, 1), "two bodies"),
        (lambda: add_thruster(empty(), 1, 1, 0), "on one"),
        (lambda: resize(joined(), FIRST, 100), "would reach"),
        (lambda: move(joined(), FIRST, 100, 1), "outside"),
        (lambda: add_body(add_body(add_body(empty(), "rectangle", 1, 1), "triangle", 1, 1), "triangle", 1, 1), "room"),
    ],
)  # fmt: skip
def test_impossible_edit_raises_one_sentence(edit, words: str) -> None:
    with pytest.raises(EditError, match=words) as error:
        edit()
    assert str(error.value).endswith(".")


def test_edits_leave_a_distant_body_where_it_is() -> None:
    """A level file may have one; only where an edit puts a body is limited."""
    level = add_body(empty(), "rectangle", 2, 2)
    level.state.position[FIRST, 0] = 12
    assert one_of(set_role(level, FIRST, Role.BLUE)).role[FIRST] == Role.BLUE
    assert one_of(add_body(level, "circle", 1, 1)).model.active[M.polygons]
    with pytest.raises(EditError, match="outside"):
        move(level, FIRST, 11, 2)
    assert one_of(move(level, FIRST, 2, 2)).state.position[FIRST, 0] == 2


def test_new_joint_has_no_impulse_of_a_deleted_one() -> None:
    level = joined()
    level.state.joint_impulse[:], level.state.joint_angular_impulse[:] = 3.0, 2.0
    level = add_joint(delete(level, "joint", 0), 2.2, 2.2)
    assert level.model.joint_active[0].all()
    assert not level.state.joint_impulse[0].any()
    assert not level.state.joint_angular_impulse[0].any()


def test_unused_corner_of_a_triangle_lies_on_its_side() -> None:
    """Pixels draw it as a corner; a level file may have it anywhere, where it does not limit the size."""
    level = add_body(empty(), "triangle", 2.0, 2.0)
    first, *_, last, unused = one_of(level).model.vertices[FIRST]
    np.testing.assert_allclose(unused, (first + last) / 2)
    level.model.vertices[FIRST, 3] = 500.0
    assert resize(level, FIRST, 1.1).model.vertices[FIRST, 0, 1] == pytest.approx(1.1 * first[1])


def test_reach_of_a_polygon_is_that_of_its_corners() -> None:
    """A square of 3.6 m has corners 2.55 m from its centre, and sides 1.8 m from it."""
    level = add_body(empty(), "rectangle", 2.0, 2.0)
    half = np.abs(one_of(level).model.vertices[FIRST]).max()
    with pytest.raises(EditError, match=r"would reach 2\.5"):
        resize(level, FIRST, 1.8 / half)


number = st.floats(-1, 6)
index = st.integers(0, 12)
ANY = st.one_of(
    st.tuples(st.just("add_body"), st.sampled_from(["circle", "rectangle", "triangle"]), number, number),
    st.tuples(st.just("move"), index, number, number),
    st.tuples(st.just("turn"), index, number),
    st.tuples(st.just("resize"), index, st.floats(0.1, 3)),
    st.tuples(st.just("set_role"), index, st.integers(0, 3)),
    st.tuples(st.just("fix"), index, st.booleans()),
    st.tuples(st.just("add_joint"), number, number, st.booleans()),
    st.tuples(st.just("add_thruster"), number, number, number),
    st.tuples(st.just("bind"), st.sampled_from(["joint", "thruster"]), index, index),
    st.tuples(st.just("delete"), st.sampled_from(["body", "joint", "thruster"]), index),
)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 50), st.lists(ANY, max_size=8))
def test_level_file_holds_the_result_of_any_edits(level_id: int, edits: list) -> None:
    level = one_level(level_id)
    for name, *words in edits:
        with suppress(EditError):
            level = EDITS[name](level, *words)
    back = from_document(to_document(LevelFile(level, TaskParams()))).level
    jax.tree.map(np.testing.assert_array_equal, back, level)


def one_level(level_id: int) -> Level:
    return jax.tree.map(np.asarray, sample_levels([level_id], M))
