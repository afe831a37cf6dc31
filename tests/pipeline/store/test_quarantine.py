"""Notes of units that were given up: removed once their levels are committed, by whatever units."""

import os
from pathlib import Path

import numpy as np
import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.look.status import status
from levelproof.pipeline.store.layout import quarantine_path, unit_name
from levelproof.pipeline.store.quarantine import drop_notes, give_up, given_up
from tests.pipeline.made import made_split


def test_given_up_returns_levels_that_are_not_done(tmp_path: Path) -> None:
    give_up(tmp_path, (3, 4, 9), "Failed 3 times")
    note = quarantine_path(tmp_path, unit_name(3, 9))
    assert note.read_text() == "Levels: 3-4, 9-9\nFailed 3 times"
    left = {
        (): [(3, 4), (9, 9)],
        (1, 10): [(3, 4), (9, 9)],
        (3, 9): [(4, 4)],
        (4,): [(3, 3), (9, 9)],
        (5, 6): [(3, 4), (9, 9)],
    }
    for done, missing in left.items():
        assert given_up(tmp_path, np.array(done, np.int64)) == {note: missing}
        drop_notes(tmp_path, np.array(done, np.int64))
    assert given_up(tmp_path, np.array([3, 4, 9])) == {}
    drop_notes(tmp_path, np.array([3, 4, 9]))
    assert not note.exists()


@pytest.mark.parametrize("text", ["", "Failed 3 times", "Levels: 3-\n", "Levels: 3-4, x\n", "\xff"])
def test_given_up_takes_levels_from_names_of_notes_without_levels(tmp_path: Path, text: str) -> None:
    note = quarantine_path(tmp_path, unit_name(3, 5))
    note.parent.mkdir()
    note.write_text(text, encoding="latin-1")
    assert given_up(tmp_path, np.array([4])) == {note: [(3, 3), (5, 5)]}
    drop_notes(tmp_path, np.array([3, 4, 5]))
    assert not note.exists()


def test_status_does_not_list_committed_levels_as_given_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED], [Label.SOLVED, Label.SOLVED]])
    give_up(split, range(2), "Failed 3 times")
    give_up(split, range(2, 6), "Failed 3 times")
    os.mkfifo(quarantine_path(split, unit_name(0, 7)))
    status(split, False, print)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Given up")]
    assert lines == [f"Given up: levels 4 to 5, for the reason in {quarantine_path(split, unit_name(2, 5))}"]
    status(split, True, print)
    assert '"quarantined": [\n    "000000000002-000000000005.txt"\n  ]' in capsys.readouterr().out
