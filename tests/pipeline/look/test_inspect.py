"""Questions about a manifest: what a condition chooses, and that nothing more is read than it takes."""

from pathlib import Path

import pytest

from experts.labels import Label
from pipeline.look.inspect import survey
from tests.pipeline.made import made_split

LABELS = [Label.SOLVED, Label.TRIVIAL, Label.UNSOLVED, Label.UNSOLVABLE]


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("data"), [LABELS] * 3)


@pytest.mark.parametrize(
    ("condition", "labels"),
    [
        ("sticky_success_rate > 0.4", {"solved": 3}),  # trivial levels have no such rate
        ("moved_success_rate IS NULL", {"trivial": 3, "unsolved": 3, "unsolvable": 3}),
        ("best_return > -1e30", {"solved": 3}),
        ("list_max(learning_curve) > 0.4", {"solved": 3, "trivial": 3, "unsolvable": 3, "unsolved": 3}),
        ("learning_curve[1] > 0.4", {}),
    ],
)
def test_what_has_no_number_is_neither_above_nor_below_one(split: Path, condition: str, labels: dict) -> None:
    assert survey(split, condition)["labels"] == labels
