"""Shapes: every field is annotated, and the engine returns the annotated shapes."""

import dataclasses
import inspect
from typing import get_type_hints

import jax
import pytest
from jaxtyping import AbstractArray

from levelproof.physics.block import Scratch
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import Buffer
from levelproof.physics.pairs import pairs_of
from levelproof.physics.step import step
from levelproof.physics.types import FIXED_POLYGONS, Manifold, Model, Params, Size, State
from tests.physics.worlds import ROOM, idle, room

FEW = Size(polygons=6, circles=3, joints=4, thrusters=2)


@pytest.mark.parametrize("cls", [Model, State, Manifold])
def test_every_field_is_annotated_with_its_shape_lanes_last(cls: type) -> None:
    hints = get_type_hints(cls)
    assert set(hints) == {field.name for field in dataclasses.fields(cls)}
    for name, hint in hints.items():
        assert issubclass(hint, AbstractArray), name
        assert hint.dim_str.split()[-1] == "lane", name


def test_step_returns_the_annotated_shapes() -> None:
    lanes = 3
    model, state = room(lanes)
    after, manifold = jax.eval_shape(lambda: step(model, state, *idle(lanes), Params()))
    for value in (model, state, after, manifold):
        annotated = buffers_of(type(value), ROOM)
        for field in dataclasses.fields(value):
            array, buffer = getattr(value, field.name), getattr(annotated, field.name)
            assert (array.shape, str(array.dtype)) == ((*buffer.shape, lanes), buffer.dtype), field.name


def test_buffers_of_follows_the_annotations_of_scratch() -> None:
    """Cover arrays with and without lanes, all dtypes, and named and numeric axes."""
    scratch = buffers_of(Scratch, FEW)
    contacts = 2 * (6 * 5 // 2 - 4 * 3 // 2) + 3 * 6 + 3
    assert scratch.bodies.motion == Buffer((9, 5))
    assert scratch.outlines.vertex == Buffer((2, 6, 4))
    assert scratch.joints.acts == Buffer((4,), "bool")
    assert scratch.constraints.impulse == Buffer((contacts, 2))
    assert scratch.constraints.acting == Buffer((contacts,), "int32", lanes=False)
    assert scratch.constraints.ends == Buffer((5 + 1,), "int32", lanes=False)  # circle-polygon pairs: two batches
    assert buffers_of(Manifold, FEW).normal == Buffer((contacts, 2))


def test_types_are_trees_of_arrays() -> None:
    model, state = room(2)
    assert len(jax.tree.leaves(model)) == len(dataclasses.fields(Model))
    assert len(jax.tree.leaves(state)) == len(dataclasses.fields(State))
    assert model.size == ROOM


def test_params_fields_have_comments() -> None:
    """Each constant has its unit or effect in a comment on its line."""
    lines = [line for line in inspect.getsource(Params).splitlines() if ": float" in line or ": bool" in line]
    assert len(lines) == len(dataclasses.fields(Params))
    assert [line for line in lines if "#" not in line] in ([], ["    base_friction: float = 0.4"])
    assert hash(Params()) == hash(Params())


@pytest.mark.parametrize("size", [ROOM, ROOM._replace(polygons=12, circles=4), ROOM._replace(polygons=6, circles=3)])
def test_pairs_of_lists_the_pairs_that_may_touch(size) -> None:
    pairs = pairs_of(size)
    polygon = set(zip(pairs.polygon.a, pairs.polygon.b, strict=True))
    every = {(i, j) for i in range(size.polygons) for j in range(i + 1, size.polygons)}
    assert polygon == {(i, j) for i, j in every if j >= FIXED_POLYGONS}
    assert len(pairs.circle_polygon) == size.circles * size.polygons
    assert len(pairs.circle) == size.circles * (size.circles - 1) // 2
    assert pairs.contacts == 2 * len(pairs.polygon) + len(pairs.circle_polygon) + len(pairs.circle)
    for kind in (pairs.polygon, pairs.circle_polygon, pairs.circle):
        assert list(zip(kind.a, kind.b, strict=True)) == sorted(zip(kind.a, kind.b, strict=True))
