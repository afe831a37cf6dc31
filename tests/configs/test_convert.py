"""typed and plain: nested mappings to typed frozen dataclasses and back."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levelproof.configs.convert import flat, plain, typed
from levelproof.configs.errors import ConfigError, suggestion


class Colour(StrEnum):
    GREEN = "green"
    BLUE = "blue"


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5
    width: int = 64

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
    inner: Inner = field(default_factory=Inner)


inners = st.builds(Inner, st.floats(0, 1e30), st.integers())
outers = st.builds(
    Outer,
    st.integers(),
    st.booleans(),
    st.text(),
    st.sampled_from(["a", "b"]),
    st.sampled_from(Colour),
    st.none() | st.integers(),
    inners,
)


@given(outers)
def test_typed_inverts_plain(value: Outer) -> None:
    assert typed(Outer, plain(value)) == value


def test_typed_parses_suffixed_counts() -> None:
    assert typed(Outer, {"count": "1.5k", "limit": "10M"}) == Outer(1500, limit=10_000_000)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"count": "1.0005k"}, "count is '1.0005k': it must be a whole number"),
        ({"count": ""}, "count is '': it must be a whole number"),
        ({"count": "7"}, "count is '7': it must be a whole number"),
        ({"count": True}, "count is True: it must be a whole number"),
        ({"count": 1.0}, "count is 1.0: it must be a whole number"),
        ({"count": 1, "on": 1}, "on is 1: it must be true or false"),
        ({"count": 1, "kind": "c"}, "kind is 'c': choose one of a, b"),
        ({"count": 1, "colour": "gren"}, r"colour is 'gren': choose one of green, blue \(did you mean green\?\)"),
        ({"count": 1, "colour": 1}, "colour is 1: choose one of green, blue"),
        ({"count": 1, "limit": "x"}, "limit is 'x': it must be a whole number"),
        ({"count": None}, "count is None: it must be a whole number"),
        ({"count": 1, "inner": 3}, "inner is 3, but must be a group of settings"),
        ({"count": 1, "inner": {"rates": 3}}, r"there is no setting inner.rates \(did you mean rate\?\)"),
        ({"count": 1, "inner": {"rate": float("nan")}}, "inner.rate is nan"),
        ({"count": 1, "inner": {"rate": -1}}, r"inner.rate is -1.0: it must not be negative"),
        ({"count": 1, "inner": "rate"}, "inner is 'rate', but must be a group of settings"),
        ({"count": 1, "inner": {"rate": 10**400}}, "inner.rate is 1000.*: it must be a number"),
        ({"count": 1, "inner": {"width": 1.5}}, "inner.width is 1.5: it must be a whole number"),
        ({"counts": 1}, "count is missing"),
    ],
)
def test_typed_names_the_wrong_value(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=f"^{sentence}") as raised:
        typed(Outer, values)
    assert str(raised.value).count("\n") == 0
    assert str(raised.value).endswith(".")
    assert not str(raised.value).endswith("..")


def test_typed_prefixes_errors_with_the_name_of_the_group() -> None:
    with pytest.raises(ConfigError, match=r"^task\.rate is 'x'"):
        typed(Inner, {"rate": "x"}, "task")
    with pytest.raises(ConfigError, match=r"^task.rate is -1.0: it must not be negative\.$"):
        typed(Inner, {"rate": -1}, "task")


def test_typed_accepts_integers_as_floats_and_strings() -> None:
    value = typed(Outer, {"count": 1, "name": 1000, "inner": {"rate": 1}})
    assert value.name == "1000"
    assert isinstance(value.inner.rate, float)


def test_flat_names_leaves_by_dotted_paths() -> None:
    assert flat({"a": {"b": 1, "c": {"d": [2]}}, "e": 3}) == {"a.b": 1, "a.c.d": [2], "e": 3}


def test_suggestion_is_empty_without_a_close_word() -> None:
    assert suggestion("zzz", ["levels"]) == ""
    assert "levels" in suggestion("levls", ["levels"])
