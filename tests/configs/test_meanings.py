"""Meanings of settings, read from the comments beside their defaults."""

from dataclasses import dataclass
from enum import StrEnum

from levelproof.configs.compose import compose_job, presets, settings
from levelproof.configs.convert import flat
from levelproof.configs.meanings import Comment, comments_in, every_setting

SETTINGS = every_setting()


@dataclass(frozen=True)
class Sample:
    """A class with a # in its docstring."""

    bare: int = 0
    # a heading
    # of two lines
    one: str = "#"  # m; of a "#"
    far: float = (
        1.0  # in a line
        + 2.0  # or two
    )

    # another one
    last: int = 1

    def method(self) -> int:
        inside: int = 1  # not a setting
        return inside


class Kind(StrEnum):
    """Members have comments, too."""

    A = "a"  # the first
    B = "b"


def test_comments_in_returns_comments_beside_and_above() -> None:
    assert comments_in(Sample) == {
        "bare": Comment("", ""),
        "one": Comment("a heading of two lines", 'm; of a "#"'),
        "far": Comment("a heading of two lines", "in a line or two"),
        "last": Comment("another one", ""),
    }
    assert comments_in(Kind) == {"A": Comment("", "the first"), "B": Comment("", "")}


def test_every_setting_has_a_meaning() -> None:
    assert [setting.name for setting in SETTINGS if len(setting.meaning) <= 8] == []


def test_every_setting_has_one_of_its_choices_by_default() -> None:
    assert [
        setting.name for setting in SETTINGS if setting.choices and str(setting.default) not in setting.choices
    ] == []


def test_every_setting_lists_each_setting_once() -> None:
    names = [setting.name for setting in SETTINGS]
    assert len(names) == len(set(names))
    assert set(names) == {*flat(settings([])), *presets()}


def test_overrides_of_all_defaults_compose_the_default_job() -> None:
    assert compose_job([setting.override for setting in SETTINGS]) == compose_job([])


def test_setting_text_lists_choices_that_the_meaning_lacks() -> None:
    text = {setting.name: setting.text for setting in SETTINGS}
    assert "flat: all features in one vector; entity: " in text["expert.network"]
    assert text["procedure"].endswith("(default, label, masters, published, thorough)")
    assert "(auto, ray, inline)" not in text["executor"]
