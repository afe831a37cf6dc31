"""Sizes and their names."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levelproof.levelgen.level import MOST_THINGS, SIZES, name_of, size_of
from levelproof.physics.types import Size


@given(st.builds(Size, *[st.integers(0, MOST_THINGS)] * 4))
def test_every_size_has_one_name(size: Size) -> None:
    assert size_of(name_of(size)) == size


def test_names() -> None:
    assert {name: size_of(name) for name in SIZES} == SIZES
    assert size_of("8-7-6-5") == Size(polygons=8, circles=7, joints=6, thrusters=5)
    assert name_of(Size(12, 4, 6, 2)) == "l"


@pytest.mark.parametrize(
    "name", ["", "x", "S", "8", "8-8-8", "8-8-8-4-4", "8,8,8,4", "08-8-8-4", "8-8--8-4", "８-8-8-4"]
)
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^size is '{name}': choose one of s, m, l, or write how many polygons"):
        size_of(name)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("5-2-1-1", "size is 5-2-1-1: that is s, so write that"),
        ("65-1-1-1", "size is 65-1-1-1: at most 64 polygons fit into a level"),
        ("6-1-999-1", "size is 6-1-999-1: at most 64 joints fit into a level"),
    ],
)
def test_a_size_that_cannot_be_is_refused(name: str, sentence: str) -> None:
    with pytest.raises(ValueError, match="size") as refused:
        size_of(name)
    assert str(refused.value) == sentence
