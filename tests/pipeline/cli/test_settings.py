"""`levelproof settings`, and the settings in `generate --help`."""

import json
from pathlib import Path

import pytest

from levelproof.configs.meanings import every_setting
from levelproof.pipeline.cli.generate import COMMON
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.cli.settings import as_markdown

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_generate_help_fits_on_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["generate", "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    assignments = {setting.name: setting.override for setting in every_setting()}
    for name in COMMON:
        assert any(line.startswith(f"  {assignments[name]}  ") for line in lines), name


def test_settings_lists_all_with_their_meanings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for setting in every_setting():
        assert f"{setting.override} {' '.join(setting.text.split())}" in text


def test_settings_selects_by_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "Learning_rate", "--json"]) == 0
    (setting,) = json.loads(capsys.readouterr().out)
    assert setting["name"] == "expert.learning_rate"
    assert setting["default"] == 2e-3
    assert setting["meaning"]


def test_settings_rejects_a_word_that_no_setting_contains(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "nothing like it"]) == 2
    assert "No setting contains the word 'nothing like it'" in capsys.readouterr().err


def test_docs_page_equals_the_list_of_settings() -> None:
    page = (DOCS / "settings.md").read_text()
    assert page == as_markdown(every_setting()), "levelproof settings --markdown > docs/settings.md"
