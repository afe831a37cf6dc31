"""Words of a command line that may be splits or settings."""

from pathlib import Path

import pytest

from levelproof.pipeline.cli.command import parted


def test_words_with_an_equals_sign_are_settings_unless_they_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lr=1").mkdir()
    assert parted(["data/128k/s", "lr=1", "seed=1"]) == ([Path("data/128k/s"), Path("lr=1")], ["seed=1"])


def test_url_with_an_equals_sign_is_a_split() -> None:
    words = ["s3://bucket/date=2024/128k/s", "start=builtin:s"]
    assert parted(words) == ([Path("s3://bucket/date=2024/128k/s")], ["start=builtin:s"])


def test_setting_may_be_longer_than_a_path() -> None:
    where = f"where=level_id IN ({', '.join(map(str, range(50_000, 51_000)))})"
    assert parted(["data/128k/s", where]) == ([Path("data/128k/s")], [where])
