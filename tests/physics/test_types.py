"""Shapes in the types are kept: every field says its own, and the engine returns what it says."""

import ast
import dataclasses
import inspect

import jax
import pytest

import physics.types
from physics.pairs import pairs_of
from physics.step import step
from physics.types import FIXED_POLYGONS, Manifold, Model, Params, State
from tests.physics.worlds import ROOM, idle, room

KINDS = {"Float": "float32", "Int": "int32", "Bool": "bool"}


def annotations(cls: type) -> dict[str, tuple[str, list[str]]]:
    """Field -> (kind, axis names), read from the source: `Float[Array, "body 2 lane"]`."""
    tree = ast.parse(inspect.getsource(cls))
    fields = {}
    for line in ast.walk(tree):
        if isinstance(line, ast.AnnAssign) and isinstance(line.annotation, ast.Subscript):
            kind, shape = line.annotation.value, line.annotation.slice
            assert isinstance(kind, ast.Name)
            assert isinstance(shape, ast.Tuple)
            assert isinstance(shape.elts[1], ast.Constant)
            fields[line.target.id] = (kind.id, str(shape.elts[1].value).split())
    return fields


@pytest.mark.parametrize("cls", [Model, State, Manifold])
def test_every_field_is_annotated_with_its_shape_lanes_last(cls: type) -> None:
    said = annotations(cls)
    assert set(said) == {field.name for field in dataclasses.fields(cls)}
    for name, (kind, axes) in said.items():
        assert kind in KINDS, name
        assert axes[-1] == "lane", name


def test_worlds_have_the_shapes_that_the_types_say() -> None:
    lanes = 3
    model, state = room(lanes)
    after, manifold = jax.eval_shape(lambda: step(model, state, *idle(lanes), Params()))
    axis = {
        "lane": lanes,
        "body": ROOM.bodies,
        "polygon": ROOM.polygons,
        "circle": ROOM.circles,
        "joint": ROOM.joints,
        "thruster": ROOM.thrusters,
        "vertex": physics.types.MAX_VERTICES,
        "contact": pairs_of(ROOM).contacts,
        "2": 2,
    }
    for value in (model, state, after, manifold):
        for name, (kind, axes) in annotations(type(value)).items():
            field = getattr(value, name)
            assert field.shape == tuple(axis[a] for a in axes), name
            assert str(field.dtype) == KINDS[kind], name


def test_types_are_trees_of_arrays() -> None:
    model, state = room(2)
    assert len(jax.tree.leaves(model)) == len(dataclasses.fields(Model))
    assert len(jax.tree.leaves(state)) == len(dataclasses.fields(State))
    assert model.size == ROOM


def test_every_number_of_the_params_says_what_it_is() -> None:
    """Each constant has its unit or effect in a comment on its line."""
    lines = [line for line in inspect.getsource(Params).splitlines() if ": float" in line or ": bool" in line]
    assert len(lines) == len(dataclasses.fields(Params))
    assert [line for line in lines if "#" not in line] in ([], ["    base_friction: float = 0.4"])
    assert hash(Params()) == hash(Params())


@pytest.mark.parametrize("size", [ROOM, ROOM._replace(polygons=12, circles=4), ROOM._replace(polygons=6, circles=3)])
def test_pairs_are_those_that_may_touch(size) -> None:
    pairs = pairs_of(size)
    polygon = set(zip(pairs.polygon.a, pairs.polygon.b, strict=True))
    every = {(i, j) for i in range(size.polygons) for j in range(i + 1, size.polygons)}
    assert polygon == {(i, j) for i, j in every if j >= FIXED_POLYGONS}
    assert len(pairs.circle_polygon) == size.circles * size.polygons
    assert len(pairs.circle) == size.circles * (size.circles - 1) // 2
    assert pairs.contacts == 2 * len(pairs.polygon) + len(pairs.circle_polygon) + len(pairs.circle)
    for kind in (pairs.polygon, pairs.circle_polygon, pairs.circle):
        assert list(zip(kind.a, kind.b, strict=True)) == sorted(zip(kind.a, kind.b, strict=True))
