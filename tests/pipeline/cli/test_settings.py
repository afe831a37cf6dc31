"""`levelproof settings`, and the help of generate: what people read about settings."""

import json
from pathlib import Path

import pytest

from levelproof.configs.meanings import every_setting
from levelproof.pipeline.cli.generate import OFTEN
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.cli.settings import as_markdown

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_the_help_of_generate_fits_on_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["generate", "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    words = {setting.name: setting.word for setting in every_setting()}
    assert len(OFTEN) == 10
    for name in OFTEN:
        assert any(line.startswith(f"  {words[name]}  ") for line in lines), name


def test_all_settings_are_listed_with_their_meanings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for setting in every_setting():
        assert f"{setting.word} {' '.join(setting.text.split())}" in text


def test_a_word_chooses(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "Learning_rate", "--json"]) == 0
    (setting,) = json.loads(capsys.readouterr().out)
    assert setting["name"] == "expert.learning_rate"
    assert setting["default"] == 2e-3
    assert setting["meaning"]


def test_a_word_that_no_setting_has_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "nothing like it"]) == 2
    assert "No setting has the word 'nothing like it'" in capsys.readouterr().err


def test_the_page_in_the_docs_is_this_list() -> None:
    page = (DOCS / "settings.md").read_text()
    assert page == as_markdown(every_setting()), "levelproof settings --markdown > docs/settings.md"
