"""How far a split is, whatever runs of ids were wanted."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experts.labels import Label
from pipeline.jobs.schedule import runs
from pipeline.look.status import inside, look
from pipeline.store.layout import JOB
from tests.pipeline.made import made_split


@given(st.sets(st.integers(0, 60)), st.sets(st.integers(0, 60)))
def test_ids_inside_of_runs(wanted: set[int], there: set[int]) -> None:
    ids = np.array(sorted(there), np.int64)
    found = inside(ids, np.array(runs(sorted(wanted)), np.int64).reshape(-1, 2))
    assert set(ids[found].tolist()) == wanted & there


def test_half_a_million_runs_are_counted_at_once() -> None:
    """Every other level of a million: a look at every run for every level would take days."""
    ids = np.arange(1_000_000)
    assert inside(ids, np.stack([ids[::2], ids[::2]], 1)).sum() == 500_000


def test_what_is_committed_of_what_is_wanted(tmp_path: Path) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL], [Label.SOLVED, Label.SOLVED]])
    (split / JOB).write_text(json.dumps({"command": "levelproof generate", "level_ids": [[1, 3], [9, 9]]}))
    facts = look(split)
    assert (facts["wanted"], facts["done"]) == (4, 3)
    assert facts["labels"] == {"solved": 1, "trivial": 1, "unsolved": 1}


@pytest.mark.parametrize("level_ids", ["[[0]]", "[[0, 1e99]]", '[["a", "b"]]', "7", "[[0, 99999999999999999999]]"])
def test_a_damaged_note_is_named(tmp_path: Path, level_ids: str) -> None:
    (tmp_path / JOB).write_text(f'{{"command": "", "level_ids": {level_ids}}}')
    with pytest.raises(Exception, match=r"job.json is damaged: run `levelproof generate` for this split again\.$"):
        look(tmp_path)
