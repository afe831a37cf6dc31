"""Formatting of counts with their nouns."""

import pytest

from levelproof.pipeline.words import many


@pytest.mark.parametrize(
    ("count", "noun", "text"),
    [
        (0, "level", "0 levels"), (1, "level", "1 level"), (12_345, "level", "12,345 levels"),
        (1, "trajectory", "1 trajectory"), (2, "trajectory", "2 trajectories"), (2, "witness", "2 witnesses"),
    ],
)  # fmt: skip
def test_many_inflects_the_noun(count: int, noun: str, text: str) -> None:
    assert many(count, noun) == text
