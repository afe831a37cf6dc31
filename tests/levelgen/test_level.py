"""Sizes and their names; levels chosen by index, and joined."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from levelproof.levelgen.level import MAX_PER_KIND, SIZES, Level, concatenate_levels, name_of, size_of
from levelproof.levelgen.sampling.sampler import sample_levels, sampler
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.physics.types import Size
from tests.trees import assert_same


@given(st.builds(Size, *[st.integers(0, MAX_PER_KIND)] * 4))
def test_size_of_reads_name_of(size: Size) -> None:
    assert size_of(name_of(size)) == size


def test_sizes_have_their_canonical_names() -> None:
    assert {name: size_of(name) for name in SIZES} == SIZES
    assert size_of("8-7-6-5") == Size(polygons=8, circles=7, joints=6, thrusters=5)
    assert name_of(Size(12, 4, 6, 2)) == "l"


@pytest.mark.parametrize(
    "name", ["", "x", "S", "8", "8-8-8", "8-8-8-4-4", "8,8,8,4", "08-8-8-4", "8-8--8-4", "８-8-8-4"]
)
def test_size_of_refuses_an_unknown_name(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^size is '{name}': choose one of s, m, l, or give the numbers of polygons"):
        size_of(name)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("5-2-1-1", "size is 5-2-1-1: write s instead"),
        ("65-1-1-1", "size is 65-1-1-1: at most 64 polygons fit into a level"),
        ("6-1-999-1", "size is 6-1-999-1: at most 64 joints fit into a level"),
    ],
)
def test_size_of_refuses_an_impossible_size(name: str, sentence: str) -> None:
    with pytest.raises(ValueError, match="size") as refused:
        size_of(name)
    assert str(refused.value) == sentence


@pytest.fixture(scope="module")
def levels() -> Level:
    return sample_levels(np.arange(12), "s")


def test_levels_have_a_length_and_are_chosen_by_index(levels: Level) -> None:
    assert len(levels) == 12
    assert len(levels[0]) == len(levels[-1]) == 1
    assert_same(levels[-1], levels[11])
    assert_same(levels[3:7], sample_levels(np.arange(3, 7), "s"))
    assert_same(levels[[5, 0]], sample_levels(np.array([5, 0]), SIZES["s"]))
    assert_same(levels[np.arange(12) > 9], levels[10:])
    assert len(levels[5:5]) == 0
    assert [len(level) for level in levels] == [1] * 12
    for wrong in 12, -13, [0, 12]:
        with pytest.raises(IndexError):
            levels[wrong]


def test_level_arrays_of_one_lane_broadcast(levels: Level) -> None:
    shared = replace(levels, model=replace(levels.model, gravity=levels.model.gravity[:, :1]))
    assert len(shared) == 12
    assert shared[2:5].model.gravity.shape == (2, 3)
    assert concatenate_levels([shared, shared[:1]]).model.gravity.shape == (2, 13)


def test_concatenate_levels_joins_several_calls(levels: Level) -> None:
    assert_same(concatenate_levels([levels[:5], levels[5:6], levels[6:]]), levels)
    with pytest.raises(ValueError, match="levels of the sizes s, 6-0-1-0 cannot be joined"):
        concatenate_levels([levels, empty_level(Size(6, 0, 1, 0), 2)])
    with pytest.raises(ValueError, match="there are no levels to join"):
        concatenate_levels([])


def test_functions_accept_a_size_by_its_name() -> None:
    assert size_of(SIZES["s"]) == SIZES["s"]
    assert_same(sample_levels([0], "s"), sample_levels([0], SIZES["s"]))
    with pytest.raises(ValueError, match="size is 'xl': choose one of s, m, l"):
        sample_levels([0], "xl")


def test_sampling_refuses_the_name_of_a_distribution() -> None:
    for refuses in (lambda: sample_levels([0], "s", "clutter"), lambda: sampler("s", "clutter")):  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match="distribution is 'clutter', but must be a Distribution"):
            refuses()
