"""Nested mappings to typed frozen dataclasses and back."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from configs.convert import flat, plain, typed
from configs.errors import ConfigError, suggestion


class Colour(Enum):
    GREEN = 1
    BLUE = 2


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5
    widths: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise ValueError(f"rate is {self.rate}: it must not be negative")


@dataclass(frozen=True)
class Outer:
    count: int
    on: bool = False
    name: str = "x"
    kind: Literal["a", "b"] = "a"
    colour: Colour = Colour.GREEN
    limit: int | None = None
    pair: tuple[int, float] = (1, 2.0)
    inner: Inner = field(default_factory=Inner)


inners = st.builds(Inner, st.floats(0, 1e30), st.lists(st.integers(), max_size=3).map(tuple))
outers = st.builds(
    Outer,
    st.integers(),
    st.booleans(),
    st.text(),
    st.sampled_from(["a", "b"]),
    st.sampled_from(Colour),
    st.none() | st.integers(),
    st.tuples(st.integers(), st.floats(allow_nan=False, allow_infinity=False)),
    inners,
)


@given(outers)
def test_plain_and_back(value: Outer) -> None:
    assert typed(Outer, plain(value)) == value


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"count": "7"}, "count is '7': it must be a whole number"),
        ({"count": True}, "count is True: it must be a whole number"),
        ({"count": 1.0}, "count is 1.0: it must be a whole number"),
        ({"count": 1, "on": 1}, "on is 1: it must be true or false"),
        ({"count": 1, "kind": "c"}, "kind is 'c': choose one of a, b"),
        ({"count": 1, "colour": "gren"}, "did you mean green"),
        ({"count": 1, "pair": [1]}, "pair has 1 entries: it needs 2"),
        ({"count": 1, "pair": 3}, "pair is 3: write a list"),
        ({"count": 1, "inner": 3}, "inner is 3, but it is a group of settings"),
        ({"count": 1, "inner": {"rates": 3}}, r"no setting inner.rates \(did you mean rate\?\)"),
        ({"count": 1, "inner": {"rate": float("nan")}}, "inner.rate is nan"),
        ({"count": 1, "inner": {"rate": -1}}, r"inner.rate is -1.0: it must not be negative"),
        ({"count": 1, "inner": {"widths": [1, "x"]}}, r"inner.widths\[1\] is 'x'"),
        ({}, "Outer is incomplete"),
    ],
)
def test_wrong_values_are_named(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        typed(Outer, values)


def test_whole_numbers_are_fine_where_numbers_or_words_are_wanted() -> None:
    value = typed(Outer, {"count": 1, "name": 1000, "inner": {"rate": 1}})
    assert value.name == "1000"
    assert isinstance(value.inner.rate, float)


def test_flat_names_leaves_by_their_paths() -> None:
    assert flat({"a": {"b": 1, "c": {"d": [2]}}, "e": 3}) == {"a.b": 1, "a.c.d": [2], "e": 3}


def test_suggestion_is_empty_for_a_stranger() -> None:
    assert suggestion("zzz", ["levels"]) == ""
    assert "levels" in suggestion("levls", ["levels"])
