"""Parsing of counts as people type them."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import MAX_COUNT, parse_count


@pytest.mark.parametrize(
    ("text", "number"),
    [("1", 1), ("500", 500), ("007", 7), ("64k", 64_000), ("1M", 10**6), ("11.5M", 11_500_000), ("0.001k", 1), (3, 3)],
)
def test_parse_count_returns_the_exact_number(text: str | int, number: int) -> None:
    assert parse_count(text, "levels") == number


@pytest.mark.parametrize("text", ["0", "0k", "-1", "abc", "", "1.5", "1e6", "64K", "1 000", "k", "1.0001k", "inf", "²"])
def test_parse_count_names_the_setting_of_an_invalid_count(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^budget is "):
        parse_count(text, "budget")


@given(st.integers(1, MAX_COUNT))
def test_parse_count_returns_every_integer_in_range(number: int) -> None:
    assert parse_count(str(number), "levels") == number


@given(st.text(max_size=12))
def test_parse_count_accepts_any_text_or_raises(text: str) -> None:
    with suppress(ConfigError):
        assert 1 <= parse_count(text, "levels") <= MAX_COUNT
